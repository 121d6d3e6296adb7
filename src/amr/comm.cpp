#include "amr/comm.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace dendrift::amr {

namespace {
constexpr int LOWEST_EXPONENT = -1152;  // weight of limb 0
}

void ExactSum::add(double x) {
  if (x == 0) return;
  if (!std::isfinite(x)) {
    ++limbs_[LIMBS];
    return;
  }
  int exponent = 0;
  const double m = std::frexp(x, &exponent);                          // |m| in [1/2, 1)
  const auto mantissa = static_cast<std::int64_t>(std::ldexp(m, 53));  // x = mantissa * 2^(exponent - 53)
  const int position = exponent - 53 - LOWEST_EXPONENT;
  const int limb = position / 32;
  const int shift = position % 32;
  const std::uint64_t magnitude = static_cast<std::uint64_t>(mantissa < 0 ? -mantissa : mantissa);
  const std::int64_t sign = mantissa < 0 ? -1 : 1;
  // 53 bits shifted by up to 31 span three limbs of 32 bits.
  const std::uint64_t low = magnitude << shift;
  const std::uint64_t high = shift == 0 ? 0 : magnitude >> (64 - shift);
  const auto i = static_cast<std::size_t>(limb);
  limbs_[i] += sign * static_cast<std::int64_t>(low & 0xffffffffU);
  limbs_[i + 1] += sign * static_cast<std::int64_t>(low >> 32);
  limbs_[i + 2] += sign * static_cast<std::int64_t>(high);
}

void ExactSum::add(const ExactSum& other) {
  for (std::size_t i = 0; i < limbs_.size(); ++i) limbs_[i] += other.limbs_[i];
}

double ExactSum::value() const {
  if (limbs_[LIMBS] != 0) return std::numeric_limits<double>::quiet_NaN();
  // Carry upwards so that each limb holds 32 bits, the sign sitting in the top one alone.
  std::array<std::int64_t, LIMBS> l{};
  std::copy_n(limbs_.begin(), LIMBS, l.begin());
  for (std::size_t i = 0; i + 1 < LIMBS; ++i) {
    const std::int64_t carry = l[i] >> 32;
    l[i] -= carry << 32;
    l[i + 1] += carry;
  }
  if (l[LIMBS - 1] < 0) {  // negate, so that the leading limbs are those of the magnitude
    ExactSum negative;
    for (std::size_t i = 0; i < LIMBS; ++i) negative.limbs_[i] = -limbs_[i];
    return -negative.value();
  }
  int top = LIMBS - 1;
  while (top > 0 && l[static_cast<std::size_t>(top)] == 0) --top;
  long double sum = 0;
  for (int i = top; i >= 0 && i > top - 4; --i)
    sum += std::ldexp(static_cast<long double>(l[static_cast<std::size_t>(i)]), 32 * i + LOWEST_EXPONENT);
  return static_cast<double>(sum);
}

std::vector<double> exact_sums(std::span<ExactSum> local, MPI_Comm comm) {
  std::vector<std::int64_t> all;
  for (ExactSum& s : local) all.insert(all.end(), s.limbs().begin(), s.limbs().end());
  MPI_Allreduce(MPI_IN_PLACE, all.data(), static_cast<int>(all.size()), MPI_INT64_T, MPI_SUM, comm);
  std::vector<double> values;
  for (std::size_t i = 0; i < local.size(); ++i) {
    ExactSum s;
    const std::size_t size = s.limbs().size();
    std::copy_n(all.begin() + static_cast<std::ptrdiff_t>(i * size), size, s.limbs().begin());
    values.push_back(s.value());
  }
  return values;
}

std::vector<double> exact_sums(std::span<const std::vector<double>> parts, std::size_t width, MPI_Comm comm) {
  std::vector<ExactSum> total(width);
  for (const std::vector<double>& part : parts)
    for (std::size_t k = 0; k < part.size(); ++k) total[k].add(part[k]);
  return exact_sums(total, comm);
}

double global_max(double x, MPI_Comm comm) {
  MPI_Allreduce(MPI_IN_PLACE, &x, 1, MPI_DOUBLE, MPI_MAX, comm);
  return x;
}

std::vector<double> global_max(std::vector<double> x, MPI_Comm comm) {
  MPI_Allreduce(MPI_IN_PLACE, x.data(), static_cast<int>(x.size()), MPI_DOUBLE, MPI_MAX, comm);
  return x;
}

double global_min(double x, MPI_Comm comm) {
  MPI_Allreduce(MPI_IN_PLACE, &x, 1, MPI_DOUBLE, MPI_MIN, comm);
  return x;
}

bool global_any(bool x, MPI_Comm comm) {
  int any = x ? 1 : 0;
  MPI_Allreduce(MPI_IN_PLACE, &any, 1, MPI_INT, MPI_MAX, comm);
  return any != 0;
}

}  // namespace dendrift::amr

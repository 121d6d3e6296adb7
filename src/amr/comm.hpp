/// \file
/// Collective operations whose results do not depend on how blocks are spread over ranks.
#pragma once

#include <mpi.h>

#include <array>
#include <cstdint>
#include <span>
#include <vector>

namespace dendrift::amr {

/// Sum of doubles without rounding: a fixed-point number wide enough for every double, so that the order of
/// the summands, hence the number of ranks and threads, cannot matter. Holds up to 2^30 summands.
class ExactSum {
 public:
  static constexpr int LIMBS = 72;  ///< 32 bits each; the lowest has weight 2^-1152

  void add(double x);
  void add(const ExactSum& other);
  double value() const;  ///< the sum, rounded at the end only; NaN if a summand was not finite
  std::span<std::int64_t> limbs() { return limbs_; }

 private:
  std::array<std::int64_t, LIMBS + 1> limbs_{};  // the last one counts summands that are not finite
};

/// Sums over all ranks, exact before the final rounding. Collective.
std::vector<double> exact_sums(std::span<ExactSum> local, MPI_Comm comm);
/// The same of `width` numbers a part; a part may be empty. Collective.
std::vector<double> exact_sums(std::span<const std::vector<double>> parts, std::size_t width, MPI_Comm comm);

double global_max(double x, MPI_Comm comm);
std::vector<double> global_max(std::vector<double> x, MPI_Comm comm);  ///< of each entry
double global_min(double x, MPI_Comm comm);
bool global_any(bool x, MPI_Comm comm);

/// Concatenates the ranks' pieces in rank order on every rank. T must be trivially copyable.
template <class T>
std::vector<T> all_gather(std::span<const T> local, MPI_Comm comm) {
  int ranks = 0;
  MPI_Comm_size(comm, &ranks);
  const int mine = static_cast<int>(local.size_bytes());
  std::vector<int> counts(static_cast<std::size_t>(ranks)), offsets(static_cast<std::size_t>(ranks), 0);
  MPI_Allgather(&mine, 1, MPI_INT, counts.data(), 1, MPI_INT, comm);
  for (std::size_t r = 1; r < counts.size(); ++r) offsets[r] = offsets[r - 1] + counts[r - 1];
  std::vector<T> all(static_cast<std::size_t>(offsets.back() + counts.back()) / sizeof(T));
  MPI_Allgatherv(local.data(), mine, MPI_BYTE, all.data(), counts.data(), offsets.data(), MPI_BYTE, comm);
  return all;
}

}  // namespace dendrift::amr

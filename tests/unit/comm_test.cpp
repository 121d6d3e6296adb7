// Sums that do not depend on who adds what when, against an exact summation of another kind.
#include "amr/comm.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "support/mesh_fixture.hpp"

using namespace dendrift;
using namespace dendrift::amr;
using test::Random;

namespace {

constexpr double kTiny = std::numeric_limits<double>::denorm_min();
constexpr double kMin = std::numeric_limits<double>::min();
constexpr double kMax = std::numeric_limits<double>::max();
constexpr double kEps = std::numeric_limits<double>::epsilon();

/// Shewchuk's summation as in Python's math.fsum: partial sums that do not overlap, rounded once at the end.
/// No partial sum may overflow.
double fsum(const std::vector<double>& values) {
  std::vector<double> partials;
  for (double x : values) {
    std::size_t kept = 0;
    for (double y : partials) {
      if (std::abs(x) < std::abs(y)) std::swap(x, y);
      const volatile double high = x + y;  // volatile: no extended precision, no contraction
      const volatile double back = high - x;
      const double low = y - back;
      if (low != 0) partials[kept++] = low;
      x = high;
    }
    partials.resize(kept);
    partials.push_back(x);
  }
  if (partials.empty()) return 0;
  double high = partials.back(), low = 0;
  partials.pop_back();
  while (!partials.empty()) {
    const double x = high, y = partials.back();
    partials.pop_back();
    const volatile double sum = x + y;
    const volatile double back = sum - x;
    high = sum;
    low = y - back;
    if (low != 0) break;
  }
  // A tie was decided without the partial sums below it.
  if (!partials.empty() && ((low < 0 && partials.back() < 0) || (low > 0 && partials.back() > 0))) {
    const double twice = 2 * low;
    const volatile double x = high + twice;
    const volatile double y = x - high;
    if (twice == y) high = x;
  }
  return high;
}

double exact(const std::vector<double>& values) {
  ExactSum sum;
  for (const double x : values) sum.add(x);
  return sum.value();
}

/// The exact result, or where that is no double one of the two beside it, of which `expected` is the nearest.
bool rounded(double got, double expected) { return got == expected || got == std::nextafter(expected, got); }

/// Exponents between the limits are equally likely: digits from one end of the range to the other.
double random_double(Random& random, int min_exponent, int max_exponent) {
  return std::ldexp(random.symmetric(), min_exponent + random.below(max_exponent - min_exponent + 1));
}

std::vector<double> random_doubles(Random& random, int count, int min_exponent, int max_exponent) {
  std::vector<double> values(static_cast<std::size_t>(count));
  for (double& x : values) x = random_double(random, min_exponent, max_exponent);
  return values;
}

int world_rank() {
  int rank = 0;
  MPI_Comm_rank(MPI_COMM_WORLD, &rank);
  return rank;
}

}  // namespace

TEST(ExactSum, ReferenceKnowsHardCases) {
  EXPECT_EQ(fsum({1e100, 1, -1e100}), 1);
  EXPECT_EQ(fsum({1, kEps / 2, kEps / 2}), 1 + kEps);
  EXPECT_EQ(fsum({1, kEps / 2, kTiny}), 1 + kEps);
}

TEST(ExactSum, OfNothingAndOfOne) {
  EXPECT_EQ(ExactSum().value(), 0);
  EXPECT_EQ(exact({0.0, -0.0, 0.0}), 0);
  Random random(1);
  for (const double x :
       {1.0, kTiny, kMin, kMin - kTiny, kMax, 1 + kEps, 3 * kTiny, 0x1.fffffffffffffp-1, 0.1}) {
    EXPECT_EQ(exact({x}), x);
    EXPECT_EQ(exact({-x}), -x);
    EXPECT_EQ(exact({x, -x}), 0);
  }
  for (int e = -1074; e <= 1023; ++e) {  // every place of the lowest and of the highest bit
    EXPECT_EQ(exact({std::ldexp(1, e)}), std::ldexp(1, e));
    const double x = std::ldexp(-0x1.fffffffffffffp0, e);
    EXPECT_EQ(exact({x}), x) << e;
  }
  for (int i = 0; i < 1000; ++i) {
    const double x = random_double(random, -1080, 1023);
    EXPECT_EQ(exact({x}), x);
  }
}

TEST(ExactSum, OfWhatIsNotFinite) {
  for (const double x : {std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity()}) {
    EXPECT_TRUE(std::isnan(exact({1, x, 2})));
    EXPECT_TRUE(std::isnan(exact({1, -x, x})));
    ExactSum sum, other;
    sum.add(1);
    other.add(x);
    sum.add(other);
    EXPECT_TRUE(std::isnan(exact_sums(std::span(&sum, 1), MPI_COMM_SELF).front()));
  }
}

TEST(ExactSum, RoundsAtTheEndOnly) {
  // Below a rounding error of the final number nothing is promised; above it nothing may be lost.
  for (const double sign : {1.0, -1.0}) {
    EXPECT_TRUE(rounded(exact({sign, sign * kEps / 2}), sign)) << "a tie";
    EXPECT_TRUE(rounded(exact({sign, sign * kEps / 2, sign * kTiny}), sign * (1 + kEps))) << "just above it";
    EXPECT_EQ(exact({sign, sign * kEps / 2, sign * kEps / 2}), sign * (1 + kEps)) << "lost one by one";
    EXPECT_EQ(exact({sign, sign * kEps / 2, sign * kEps / 4}), sign * (1 + kEps));
    EXPECT_EQ(exact({sign, sign * kEps / 2, -sign * kEps / 4}), sign);
    EXPECT_EQ(exact({sign, -sign * kEps / 4, -sign * kEps / 4}), sign * (1 - kEps / 2));
    EXPECT_EQ(exact({sign * 2, -sign * kEps, sign * kTiny, -sign * kTiny}), sign * (2 - kEps))
        << "long carries";
    EXPECT_EQ(exact({sign * kMin, -sign * kTiny}), sign * (kMin - kTiny));
  }
}

TEST(ExactSum, SurvivesHugeCancellation) {
  EXPECT_EQ(exact({1e308, 1, -1e308}), 1);
  EXPECT_EQ(exact({kMax, kTiny, -kMax}), kTiny);
  EXPECT_EQ(exact({kMax, kMax, -kMax, -kMax, -kTiny}), -kTiny) << "the sum on the way is no double";
  EXPECT_EQ(exact({1e16, 1, 1e-16, -1e16, -1}), 1e-16);
  EXPECT_TRUE(std::isinf(exact({kMax, kMax})));
  EXPECT_EQ(exact({kMax, kMax, -kMax}), kMax);
  Random random(2);
  for (int trial = 0; trial < 50; ++trial) {
    std::vector<double> values = random_doubles(random, 200, -1080, 1020);
    for (std::size_t i = 0; i < 200; ++i) values.push_back(-values[i]);
    const double rest = random_double(random, -1080, 1000);
    values.push_back(rest);
    random.shuffle(values);
    EXPECT_EQ(exact(values), rest);
  }
}

TEST(ExactSum, AddsSubnormals) {
  ExactSum sum;
  for (int i = 1; i <= 100000; ++i) {
    sum.add(kTiny);
    if (i % 9973 == 0) {
      EXPECT_EQ(sum.value(), i * kTiny);
    }
  }
  EXPECT_EQ(sum.value(), 100000 * kTiny);
  Random random(3);
  for (int trial = 0; trial < 50; ++trial) {
    const std::vector<double> values = random_doubles(random, 300, -1080, -1010);
    EXPECT_EQ(exact(values), fsum(values));
  }
}

TEST(ExactSum, AgreesWithExactReference) {
  Random random(4);
  for (int trial = 0; trial < 100; ++trial) {
    for (const auto& [low, high] : {std::pair(-3, 3), {-60, 60}, {-300, 300}, {-1080, 1000}}) {
      const std::vector<double> values = random_doubles(random, 1 + random.below(300), low, high);
      EXPECT_TRUE(rounded(exact(values), fsum(values))) << values.size() << " exponents from " << low;
    }
  }
  // One sign and much of it; a long double holds this sum, and 0.1 is not a round number in binary.
  std::vector<double> tenths(200000, 0.1);
  EXPECT_TRUE(rounded(exact(tenths), fsum(tenths)));
  long double sum = 0;
  std::vector<double> small(1024);
  for (double& x : small)
    sum += static_cast<long double>(x = std::ldexp(random.below(1 << 20) - (1 << 19), -20));
  EXPECT_EQ(exact(small), static_cast<double>(sum));
}

TEST(ExactSum, DoesNotDependOnOrderOrGrouping) {
  Random random(5);
  std::vector<double> values = random_doubles(random, 500, -200, 200);
  const double expected = exact(values);
  for (int trial = 0; trial < 100; ++trial) {
    random.shuffle(values);
    EXPECT_TRUE(test::same_bits(exact(values), expected));
    std::vector<ExactSum> parts(static_cast<std::size_t>(1 + random.below(9)));
    for (const double x : values)
      parts[static_cast<std::size_t>(random.below(static_cast<int>(parts.size())))].add(x);
    ExactSum total;
    for (const ExactSum& part : parts) total.add(part);
    EXPECT_TRUE(test::same_bits(total.value(), expected));
    EXPECT_TRUE(test::same_bits(total.value(), expected)) << "asking twice";
  }
}

TEST(ExactSum, HoldsTwoToTheThirtySummands) {
  // Doubling thirty times is as good as adding 2^30 times. Every place of the number in its limb, both signs;
  // then as much of the opposite sign is taken away again.
  for (int e = -1074; e <= 990; e += (e < -1000 || e > 950 ? 1 : 7)) {
    for (const double x : {std::ldexp(0x1.fffffffffffffp0, e), -std::ldexp(0x1.fffffffffffffp0, e)}) {
      ExactSum sum;
      sum.add(x);
      for (int i = 0; i < 30; ++i) {
        const ExactSum copy = sum;
        sum.add(copy);
      }
      EXPECT_EQ(sum.value(), std::ldexp(x, 30)) << "exponent " << e;
    }
    ExactSum sum;
    for (int k = 0; k < 40; ++k)
      sum.add(std::ldexp(k % 2 == 0 ? 0x1.fffffffffffffp0 : -0x1.5555555555555p0, e));
    const double small = sum.value();
    for (int i = 0; i < 24; ++i) {
      const ExactSum copy = sum;
      sum.add(copy);
    }
    EXPECT_EQ(sum.value(), std::ldexp(small, 24)) << "exponent " << e;
  }
}

TEST(MpiComm, ExactSumsDoNotDependOnRanks) {
  Random random(6);
  const int ranks = test::ranks_of(MPI_COMM_WORLD);
  for (int trial = 0; trial < 20; ++trial) {
    constexpr std::size_t kSums = 5;
    std::vector<ExactSum> local(kSums);
    std::vector<double> expected;
    for (std::size_t s = 0; s < kSums; ++s) {
      std::vector<double> values =
          random_doubles(random, 100 * static_cast<int>(s), -1080, s == 4 ? 1000 : 40);
      for (const double x : values) {
        if (random.below(ranks) == world_rank()) local[s].add(x);
      }
      expected.push_back(fsum(values));
    }
    const std::vector<double> sums = exact_sums(local, MPI_COMM_WORLD);
    ASSERT_EQ(sums.size(), kSums);
    for (std::size_t s = 0; s < kSums; ++s) EXPECT_TRUE(rounded(sums[s], expected[s])) << "sum " << s;
  }
  EXPECT_TRUE(exact_sums({}, MPI_COMM_WORLD).empty());
}

TEST(MpiComm, ExactSumsHoldTheirSummandsOnEveryRank) {
  const int ranks = test::ranks_of(MPI_COMM_WORLD);
  std::vector<ExactSum> local(1);
  local[0].add(-0x1.fffffffffffffp40);
  for (int i = 0; i < 26; ++i) {
    const ExactSum copy = local[0];
    local[0].add(copy);
  }
  EXPECT_EQ(exact_sums(local, MPI_COMM_WORLD)[0], ranks * -0x1.fffffffffffffp66);
}

TEST(MpiComm, GlobalExtremesAndAny) {
  const int rank = world_rank(), ranks = test::ranks_of(MPI_COMM_WORLD);
  EXPECT_EQ(global_max(-1.0 - rank, MPI_COMM_WORLD), -1);
  EXPECT_EQ(global_max(0.5 * rank, MPI_COMM_WORLD), 0.5 * (ranks - 1));
  EXPECT_EQ(global_min(-1.0 - rank, MPI_COMM_WORLD), -ranks);
  EXPECT_EQ(global_min(1.0 + rank, MPI_COMM_WORLD), 1);
  EXPECT_FALSE(global_any(false, MPI_COMM_WORLD));
  for (int who = 0; who < ranks; ++who) EXPECT_TRUE(global_any(rank == who, MPI_COMM_WORLD));
}

TEST(MpiComm, AllGatherConcatenatesInRankOrder) {
  struct Item {
    int rank;
    double value;
    char letter;
    bool operator==(const Item&) const = default;
  };
  Random random(7);
  const int rank = world_rank(), ranks = test::ranks_of(MPI_COMM_WORLD);
  for (int trial = 0; trial < 20; ++trial) {
    std::vector<Item> expected, mine;
    for (int r = 0; r < ranks; ++r) {
      const int count = trial == 0 ? 0 : random.below(4) * random.below(40);  // nothing, now and then
      for (int i = 0; i < count; ++i) {
        const Item item{r, random.symmetric(), static_cast<char>('a' + i % 26)};
        expected.push_back(item);
        if (r == rank) mine.push_back(item);
      }
    }
    EXPECT_EQ(all_gather<Item>(mine, MPI_COMM_WORLD), expected);
  }
  const int one = 3 * rank;
  const std::vector<int> all = all_gather<int>(std::span(&one, 1), MPI_COMM_WORLD);
  ASSERT_EQ(all.size(), static_cast<std::size_t>(ranks));
  for (int r = 0; r < ranks; ++r) EXPECT_EQ(all[static_cast<std::size_t>(r)], 3 * r);
}

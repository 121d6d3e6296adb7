// Copies, means and prolongation between arrays.
#include "amr/transfer.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "support/mesh_fixture.hpp"

using namespace dendrift;
using namespace dendrift::amr;
using test::Quadratic;
using test::Random;

namespace {

/// An array with a margin on all sides, cell 0 inside; every cell starts as a number of its own.
struct Field {
  IntVec size{};
  std::vector<double> data;
  static constexpr int kMargin = 4;

  Field(const IntVec& cells, int seed) : size(cells) {
    for (int& s : size) s += 2 * kMargin;
    data.resize(static_cast<std::size_t>(volume(size)));
    for (std::size_t i = 0; i < data.size(); ++i) data[i] = test::noise(seed, i);
  }
  ArrayRef<double> ref() {
    ArrayRef<double> r = packed_ref(data.data(), size);
    r.p = r.at(filled(kMargin));
    return r;
  }
  ArrayRef<const double> ref() const {
    ArrayRef<const double> r = packed_ref(data.data(), size);
    r.p = r.at(filled(kMargin));
    return r;
  }
  template <class F>
  void for_each(F&& f) const {
    for_each_cell(filled(-kMargin), size, f);
  }
};

bool in_box(const IntVec& cell, const IntVec& lo, const IntVec& size) {
  for (int a = 0; a < DIM; ++a)
    if (cell[a] < lo[a] || cell[a] >= lo[a] + size[a]) return false;
  return true;
}

IntVec random_vec(Random& random, int lo, int hi) {
  IntVec v{};
  for (int& x : v) x = lo + random.below(hi - lo + 1);
  return v;
}

Quadratic random_quadratic(Random& random) {
  Quadratic q;
  q.constant = random.symmetric();
  for (int a = 0; a < DIM; ++a) {
    q.origin[a] = random.symmetric();
    q.linear[a] = random.symmetric();
    for (int b = a; b < DIM; ++b) q.second[a][b] = random.symmetric();
  }
  return q;
}

RealVec centre(const IntVec& cell, double dx) {
  RealVec x{};
  for (int a = 0; a < DIM; ++a) x[a] = (cell[a] + 0.5) * dx;
  return x;
}

}  // namespace

TEST(Transfer, LayoutCountsFromTheFirstInteriorCell) {
  for (const int n : {8, 16, 32}) {
    const Layout layout{n};
    EXPECT_EQ(layout.pitch(), n + 2 * Layout::GHOSTS);
    EXPECT_EQ(layout.stride(0), 1) << "x is contiguous";
    EXPECT_EQ(layout.offset(IntVec{}), 0);
    std::vector<int> hits(static_cast<std::size_t>(layout.size()), 0);
    std::ptrdiff_t next = 0;
    bool in_order = true;
    test::for_all(layout, [&](const IntVec& cell) {
      const std::ptrdiff_t place = layout.interior() + layout.offset(cell);
      in_order = in_order && place == next++;
      ++hits.at(static_cast<std::size_t>(place));
    });
    EXPECT_TRUE(in_order);
    EXPECT_EQ(hits, std::vector<int>(hits.size(), 1));
  }
}

TEST(Transfer, LoopsVisitEveryCellOnceInIndexOrder) {
  const IntVec lo = test::vec(-2, 3, -1), size = test::vec(3, 2, 4);
  std::vector<IntVec> visited;
  for_each_cell(lo, size, [&](const IntVec& c) { visited.push_back(c); });
  ASSERT_EQ(static_cast<std::int64_t>(visited.size()), volume(size));
  for (std::size_t i = 0; i < visited.size(); ++i) {
    int rest = static_cast<int>(i);
    for (int a = 0; a < DIM; ++a) {
      EXPECT_EQ(visited[i][a], lo[a] + rest % size[a]);
      rest /= size[a];
    }
  }
  int rows = 0;
  for_each_row(size, [&](const IntVec& row) {
    EXPECT_EQ(row[0], 0);
    ++rows;
  });
  EXPECT_EQ(rows, volume(size) / size[0]);
}

TEST(Transfer, ParallelForVisitsEachBlockOnce) {
  std::vector<int> visits(1000, 0);
  parallel_for(1000, [&](int b) { ++visits[static_cast<std::size_t>(b)]; });
  EXPECT_EQ(visits, std::vector<int>(1000, 1));
  parallel_for(0, [&](int) { ADD_FAILURE(); });
}

TEST(Transfer, CopyBoxCopiesTheBoxAndNothingElse) {
  Random random(1);
  test::Tally tally;
  for (int trial = 0; trial < 50; ++trial) {
    Field dst(filled(8), 1);
    const Field src(random_vec(random, 6, 11), 2), before = dst;
    const IntVec dst_lo = random_vec(random, -4, 6), src_lo = random_vec(random, -4, 3);
    const IntVec size = random_vec(random, 0, 6);
    copy_box(dst.ref(), dst_lo, src.ref(), src_lo, size);
    dst.for_each([&](const IntVec& c) {
      IntVec from{};
      for (int a = 0; a < DIM; ++a) from[a] = c[a] - dst_lo[a] + src_lo[a];
      const double expected = in_box(c, dst_lo, size) ? *src.ref().at(from) : *before.ref().at(c);
      tally.bits(*dst.ref().at(c), expected, [&] { return test::text(c); });
    });
  }
  EXPECT_TRUE(tally.result());
}

TEST(Transfer, RestrictBoxTakesMeans) {
  Random random(2);
  test::Tally tally;
  for (int trial = 0; trial < 50; ++trial) {
    Field dst(filled(8), 3);
    const Field src(random_vec(random, 12, 15), 4), before = dst;
    const IntVec dst_lo = random_vec(random, -4, 6), src_lo = random_vec(random, -4, 3);
    const IntVec size = random_vec(random, 0, 6);
    restrict_box(dst.ref(), dst_lo, src.ref(), src_lo, size);
    dst.for_each([&](const IntVec& c) {
      if (!in_box(c, dst_lo, size)) {
        tally.bits(*dst.ref().at(c), *before.ref().at(c), [&] { return "outside, " + test::text(c); });
        return;
      }
      double sum = 0;
      for (int child = 0; child < CHILDREN; ++child) {
        IntVec fine{};
        for (int a = 0; a < DIM; ++a) fine[a] = src_lo[a] + 2 * (c[a] - dst_lo[a]) + (child >> a & 1);
        sum += *src.ref().at(fine);
      }
      tally.near(*dst.ref().at(c), sum / CHILDREN, 1e-15, [&] { return test::text(c); });
    });
  }
  EXPECT_TRUE(tally.result());
}

TEST(Transfer, ChildrenKeepTheMeanOfAnyData) {
  test::Tally tally;
  for (int trial = 0; trial < 200; ++trial) {
    std::array<double, DIRECTIONS> around{};
    for (std::size_t d = 0; d < around.size(); ++d) around[d] = test::noise(5, trial, d);
    double sum = 0, deviation = 0;
    for (int child = 0; child < CHILDREN; ++child) {
      Array<double> side{};
      for (int a = 0; a < DIM; ++a) side[a] = (child >> a & 1) != 0 ? 1 : -1;
      const double v = child_value(around.data() + CENTRE, packed_ref(around.data(), filled(3)).stride, side);
      sum += v;
      deviation += std::abs(v - around[CENTRE]);
    }
    tally.near(sum / CHILDREN, around[CENTRE], 1e-15, [&] { return "trial " + std::to_string(trial); });
    tally.expect(deviation > 1e-3, [] { return std::string("children that all equal their parent"); });
  }
  EXPECT_TRUE(tally.result());
}

TEST(Transfer, ProlongBoxIsExactForQuadratics) {
  Random random(3);
  test::Tally tally;
  for (int trial = 0; trial < 50; ++trial) {
    const Quadratic q = random_quadratic(random);
    const double dx = 0.25;
    Field coarse(filled(6), 6), fine(filled(10), 7);
    coarse.for_each([&](const IntVec& c) { *coarse.ref().at(c) = q.mean(centre(c, 2 * dx), 2 * dx); });
    const Field before = fine;
    const IntVec lo = random_vec(random, -4, 5), size = random_vec(random, 0, 9);  // odd places and sizes too
    prolong_box(fine.ref(), lo, std::as_const(coarse).ref(), size);
    fine.for_each([&](const IntVec& c) {
      if (!in_box(c, lo, size)) {
        tally.bits(*fine.ref().at(c), *before.ref().at(c), [&] { return "outside, " + test::text(c); });
      } else {
        tally.near(*fine.ref().at(c), q.mean(centre(c, dx), dx), 1e-12, [&] { return test::text(c); });
      }
    });
  }
  EXPECT_TRUE(tally.result());
}

// A plane of angles, each moved by any number of periods: exact both ways, modulo the period.
TEST(Transfer, AnglesAreEqualModuloThePeriod) {
  constexpr double PERIOD = M_PI / 2;
  const auto plane = [](const RealVec& x) {
    double v = 0.3;
    for (int a = 0; a < DIM; ++a) v += (a == 0 ? 0.9 : -0.4) * x[a];
    return v;
  };
  Random random(11);
  const auto moved = [&](double v) { return v + PERIOD * (random.below(7) - 3); };
  Field coarse(filled(6), 6), fine(filled(12), 7), back(filled(6), 8);
  coarse.for_each([&](const IntVec& c) { *coarse.ref().at(c) = moved(plane(centre(c, 0.5))); });
  prolong_angles(fine.ref(), filled(0), std::as_const(coarse).ref(), filled(12), PERIOD);
  test::Tally tally;
  for_each_cell(filled(0), filled(12), [&](const IntVec& c) {
    tally.near(wrapped(*fine.ref().at(c) - plane(centre(c, 0.25)), PERIOD), 0, 1e-13, [&] { return test::text(c); });
  });
  fine.for_each([&](const IntVec& c) { *fine.ref().at(c) = moved(plane(centre(c, 0.25))); });
  restrict_angles(back.ref(), filled(0), std::as_const(fine).ref(), filled(0), filled(6), PERIOD);
  for_each_cell(filled(0), filled(6), [&](const IntVec& c) {
    tally.near(wrapped(*back.ref().at(c) - plane(centre(c, 0.5)), PERIOD), 0, 1e-13, [&] { return test::text(c); });
  });
  EXPECT_TRUE(tally.result());
}

// Where two values meet, children have one of them; labels are never mixed.
TEST(Transfer, StepsOfAnglesAndLabelsStaySteps) {
  Field coarse(filled(6), 6), fine(filled(12), 7), back(filled(6), 8);
  coarse.for_each([&](const IntVec& c) { *coarse.ref().at(c) = c[0] + c[1] < 5 ? 0.1 : 0.7; });
  test::Tally tally;
  for (const bool labels : {false, true}) {
    if (labels) {
      prolong_labels(fine.ref(), filled(0), std::as_const(coarse).ref(), filled(12));
      restrict_labels(back.ref(), filled(0), std::as_const(fine).ref(), filled(0), filled(6));
    } else {
      prolong_angles(fine.ref(), filled(0), std::as_const(coarse).ref(), filled(12), M_PI / 2);
      restrict_angles(back.ref(), filled(0), std::as_const(fine).ref(), filled(0), filled(6), M_PI / 2);
    }
    for_each_cell(filled(0), filled(12), [&](const IntVec& c) {
      tally.bits(*fine.ref().at(c), c[0] / 2 + c[1] / 2 < 5 ? 0.1 : 0.7, [&] { return test::text(c); });
    });
    for_each_cell(filled(0), filled(6), [&](const IntVec& c) {
      tally.bits(*back.ref().at(c), *coarse.ref().at(c), [&] { return test::text(c); });
    });
  }
  EXPECT_TRUE(tally.result());
}

TEST(Transfer, RestrictionUndoesProlongation) {
  const Field coarse(filled(6), 8);
  Field fine(filled(12), 9), back(filled(6), 10);
  prolong_box(fine.ref(), filled(0), coarse.ref(), filled(12));
  restrict_box(back.ref(), filled(0), std::as_const(fine).ref(), filled(0), filled(6));
  test::Tally tally;
  for_each_cell(filled(0), filled(6), [&](const IntVec& c) {
    tally.near(*back.ref().at(c), *coarse.ref().at(c), 4e-15, [&] { return test::text(c); });
  });
  EXPECT_TRUE(tally.result());
}

TEST(Transfer, ProlongationIsOfThirdOrder) {
  // Means of cos(k.x + p) over a cell are known exactly: a product of sinc functions times the value at its
  // centre.
  const Array<double> k = [] {
    Array<double> r{};
    for (int a = 0; a < DIM; ++a) r[a] = 1.0 + 0.5 * a;
    return r;
  }();
  const auto mean = [&](const RealVec& x, double dx) {
    double phase = 0.3, damping = 1;
    for (int a = 0; a < DIM; ++a) {
      phase += k[a] * x[a];
      damping *= std::sin(k[a] * dx / 2) / (k[a] * dx / 2);
    }
    return damping * std::cos(phase);
  };
  std::vector<double> errors;
  for (int n : {8, 16, 32}) {
    const double dx = 1.0 / n;
    Field coarse(filled(n / 2), 11), fine(filled(n), 12);
    coarse.for_each([&](const IntVec& c) { *coarse.ref().at(c) = mean(centre(c, 2 * dx), 2 * dx); });
    prolong_box(fine.ref(), filled(0), std::as_const(coarse).ref(), filled(n));
    double worst = 0;
    for_each_cell(filled(0), filled(n), [&](const IntVec& c) {
      worst = std::max(worst, std::abs(*fine.ref().at(c) - mean(centre(c, dx), dx)));
    });
    errors.push_back(worst);
  }
  for (std::size_t i = 1; i < errors.size(); ++i) {
    const double order = std::log2(errors[i - 1] / errors[i]);
    EXPECT_GT(order, 2.8);
    EXPECT_LT(order, 3.3);
  }
}

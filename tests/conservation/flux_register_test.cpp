// What leaves a coarse block through a face enters the fine ones behind it, to the last bit of rounding.
#include "amr/flux_register.hpp"

#include <gtest/gtest.h>
#include <mpi.h>

#include <cmath>
#include <vector>

#include "amr/comm.hpp"
#include "support/mesh_fixture.hpp"

using namespace dendrift;
using namespace dendrift::amr;
using test::Deal;
using test::Random;
using test::Tally;

namespace {

constexpr int kMaxLeaves = DIM == 2 ? 120 : 70;
constexpr double kEps = std::numeric_limits<double>::epsilon();

struct Domain {
  IntVec roots;
  Array<bool> periodic;
};

std::vector<Domain> domains() {
  using test::axes, test::vec;
  return {{vec(1, 1, 1), axes(true, true, true)},
          {vec(2, 1, 1), axes(false, false, false)},
          {vec(1, 3, 2), axes(true, false, true)},
          {vec(2, 2, 2), axes(true, true, false)}};
}

FieldSpec spec_of(const std::string& name) {
  FieldSpec spec;
  spec.name = name;
  spec.transfer = Transfer::conservative;
  return spec;
}

/// A flux through every face of every level that both its cells agree on; nothing passes a wall.
double random_flux(const Mesh& mesh, int seed, int level, int axis, IntVec face) {
  const int extent = (mesh.shape().root_blocks[axis] << level) * mesh.layout().n;
  if (mesh.shape().periodic()[axis])
    face[axis] %= extent;
  else if (face[axis] == 0 || face[axis] == extent)
    return 0;
  return test::noise(seed, level, axis, face[0], face[1], face[DIM - 1]);
}

/// Calls f(place, cell) for the n^(DIM-1) faces on one side of a block in the packed order; a face belongs to
/// the cell whose low face it is.
template <class F>
void for_side(const Mesh& mesh, int face, F&& f) {
  IntVec size = filled(mesh.layout().n), lo{};
  size[face_axis(face)] = 1;
  lo[face_axis(face)] = face_is_high(face) ? mesh.layout().n : 0;
  std::size_t place = 0;
  for_each_cell(lo, size, [&](const IntVec& c) { f(place++, c); });  // the lower tangential axis runs fastest
}

/// Fills what the register asks for with flux(level, axis, global face).
template <class Flux>
void store_fluxes(const Mesh& mesh, FluxRegister& fluxes, Flux&& flux) {
  for (int b = 0; b < mesh.size(); ++b) {
    for (int face = 0; face < FACES; ++face) {
      double* out = fluxes.store(b, face);
      if (out == nullptr) continue;
      for_side(mesh, face, [&](std::size_t i, const IntVec& c) {
        out[i] = flux(mesh.block(b).index.level, face_axis(face),
                      test::global_cell(mesh.block(b), c, mesh.layout().n));
      });
    }
  }
}

/// field += weight * div(flux), block by block.
template <class Flux>
void advance(Mesh& mesh, CellField field, double weight, Flux&& flux) {
  for (int b = 0; b < mesh.size(); ++b) {
    const Block& block = mesh.block(b);
    double* p = mesh.cells(field, b);
    test::for_interior(mesh.layout(), [&](const IntVec& c) {
      double div = 0;
      for (int a = 0; a < DIM; ++a) {
        IntVec low = test::global_cell(block, c, mesh.layout().n), high = low;
        ++high[a];
        div += (flux(block.index.level, a, high) - flux(block.index.level, a, low)) / block.dx;
      }
      p[mesh.layout().offset(c)] += weight * div;
    });
  }
}

/// The integral of a field and of its absolute value, without rounding in the sum: spacings are powers of
/// two.
std::vector<double> integrals(const Mesh& mesh, CellField field) {
  std::vector<ExactSum> sums(2);
  for (int b = 0; b < mesh.size(); ++b) {
    const double cell = std::pow(mesh.block(b).dx, DIM);
    test::for_interior(mesh.layout(), [&](const IntVec& c) {
      const double x = mesh.cells(field, b)[mesh.layout().offset(c)] * cell;
      sums[0].add(x);
      sums[1].add(std::abs(x));
    });
  }
  return exact_sums(sums, mesh.comm());
}

Neighbour::Kind across(const Mesh& mesh, int b, int face) {
  return mesh.tree().neighbour(mesh.block(b).leaf, direction_index(face_offset(face))).kind;
}

/// Mean of the fine fluxes less the coarse one, from the definition.
template <class Flux>
double difference(Flux&& flux, int level, int axis, const IntVec& face) {
  double sum = 0;
  for (int child = 0; child < CHILDREN; ++child) {
    if ((child >> axis & 1) != 0) continue;
    IntVec fine{};
    for (int a = 0; a < DIM; ++a) fine[a] = 2 * face[a] + (child >> a & 1);
    sum += flux(level + 1, axis, fine);
  }
  return sum / (CHILDREN / 2) - flux(level, axis, face);
}

}  // namespace

TEST(MpiFluxRegister, StoresWhereLevelsMeet) {
  FieldTable table;
  table.add_cell(spec_of("u"));
  Random random(1);
  int stores = 0;
  for (const Domain& domain : domains()) {
    const Tree tree = test::random_tree(random, domain.roots, domain.periodic, 3, kMaxLeaves);
    Mesh mesh(test::shape_of(domain.roots, domain.periodic, 3), table, MPI_COMM_WORLD);
    FluxRegister fluxes(mesh);
    fluxes.prepare();
    for (int b = 0; b < mesh.size(); ++b)
      test::put(mesh, tree, test::deal_out(Deal::scattered, tree, mesh.ranks(), random));
    fluxes.prepare();
    for (int b = 0; b < mesh.size(); ++b) {
      for (int face = 0; face < FACES; ++face) {
        const Neighbour::Kind kind = across(mesh, b, face);
        const bool expected = kind == Neighbour::Kind::coarser || kind == Neighbour::Kind::finer;
        EXPECT_EQ(fluxes.store(b, face) != nullptr, expected)
            << test::text(mesh.block(b).index) << " face " << face;
        if (expected) ++stores;
      }
    }
  }
  EXPECT_GT(test::over_ranks(stores, MPI_COMM_WORLD), 0);
}

TEST(MpiFluxRegister, DifferencesAreMeanOfFineLessCoarse) {
  FieldTable table;
  table.add_cell(spec_of("u"));
  Random random(2);
  for (const Domain& domain : domains()) {
    for (const Deal deal : test::kDeals) {
      const Tree tree = test::random_tree(random, domain.roots, domain.periodic, 3, kMaxLeaves);
      Mesh mesh(test::shape_of(domain.roots, domain.periodic, 3), table, MPI_COMM_WORLD);
      test::put(mesh, tree, test::deal_out(deal, tree, mesh.ranks(), random));
      const auto flux = [&](int level, int axis, const IntVec& face) {
        return random_flux(mesh, 3, level, axis, face);
      };
      FluxRegister fluxes(mesh);
      fluxes.prepare();
      store_fluxes(mesh, fluxes, flux);
      struct Visit {
        int face;
        std::vector<double> values;
      };
      std::vector<std::vector<Visit>> visits(static_cast<std::size_t>(mesh.size()));
      const std::size_t count = static_cast<std::size_t>(volume(filled(mesh.layout().n)) / mesh.layout().n);
      fluxes.reflux([&](int b, int face, const double* values) {
        visits[static_cast<std::size_t>(b)].push_back({face, {values, values + count}});
      });
      Tally tally;
      for (int b = 0; b < mesh.size(); ++b) {
        const Block& block = mesh.block(b);
        std::vector<int> expected, visited;
        for (int face = 0; face < FACES; ++face)
          if (across(mesh, b, face) == Neighbour::Kind::finer) expected.push_back(face);
        for (const Visit& v : visits[static_cast<std::size_t>(b)]) {
          visited.push_back(v.face);
          for_side(mesh, v.face, [&](std::size_t i, const IntVec& c) {
            const IntVec g = test::global_cell(block, c, mesh.layout().n);
            tally.near(v.values[i], difference(flux, block.index.level, face_axis(v.face), g), 1e-15, [&] {
              return test::text(block.index) + " face " + std::to_string(v.face) + " cell " + test::text(c);
            });
          });
        }
        EXPECT_EQ(visited, expected) << "every face with finer blocks once, in order: "
                                     << test::text(block.index);
      }
      EXPECT_TRUE(tally.result()) << test::text(domain.roots) << " deal " << static_cast<int>(deal);
      EXPECT_GT(test::over_ranks(tally.checks(), MPI_COMM_WORLD), 0);
    }
  }
}

TEST(MpiFluxRegister, CorrectedIntegralIsConserved) {
  FieldTable table;
  const CellField u = table.add_cell(spec_of("u")), v = table.add_cell(spec_of("v"));
  Random random(3);
  for (const Domain& domain : domains()) {
    Mesh mesh(test::shape_of(domain.roots, domain.periodic, 3), table, MPI_COMM_WORLD);
    FluxRegister of_u(mesh), of_v(mesh);  // one each, through several meshes
    for (int change = 0; change < 3; ++change) {
      const Tree tree = test::random_tree(random, domain.roots, domain.periodic, 3, kMaxLeaves);
      test::put(mesh, tree,
                test::deal_out(test::kDeals[static_cast<std::size_t>(change)], tree, mesh.ranks(), random));
      test::set_noise(mesh, u, change);
      test::set_noise(mesh, v, 10 + change);
      for (int step = 0; step < 2; ++step) {
        const double weight = step == 1 ? 0.01 : -0.01;
        const auto before_u = integrals(mesh, u), before_v = integrals(mesh, v);
        const auto flux = [&](int level, int axis, const IntVec& f) {
          return random_flux(mesh, step, level, axis, f);
        };
        const auto flux_v = [&](int level, int axis, const IntVec& f) {
          return random_flux(mesh, 20 + step, level, axis, f);
        };
        of_u.prepare();
        of_v.prepare();
        store_fluxes(mesh, of_u, flux);
        store_fluxes(mesh, of_v, flux_v);
        advance(mesh, u, weight, flux);
        advance(mesh, v, weight, flux_v);
        const auto wrong = integrals(mesh, u);
        of_u.correct(u, weight);
        of_v.correct(v, weight);
        const auto after_u = integrals(mesh, u), after_v = integrals(mesh, v);
        // A rounding error or two a cell, of the size of the terms that were added.
        const double finest = mesh.shape().dx(mesh.tree().finest_level());
        double box = 1;
        for (int a = 0; a < DIM; ++a) box *= mesh.shape().hi()[a] - mesh.shape().lo[a];
        const double bound = kEps * (after_u[1] + after_v[1] + 2 * DIM * std::abs(weight) / finest * box);
        EXPECT_LE(std::abs(after_u[0] - before_u[0]), bound) << test::text(domain.roots) << " step " << step;
        EXPECT_LE(std::abs(after_v[0] - before_v[0]), bound) << test::text(domain.roots) << " step " << step;
        EXPECT_GT(std::abs(wrong[0] - before_u[0]), 1e3 * bound)
            << "nothing to correct: a test without teeth";
      }
    }
  }
}

TEST(MpiFluxRegister, CorrectsOnlyCoarseCellsAtTheFace) {
  FieldTable table;
  const CellField u = table.add_cell(spec_of("u"));
  Random random(4);
  for (const Domain& domain : domains()) {
    const Tree tree = test::random_tree(random, domain.roots, domain.periodic, 3, kMaxLeaves);
    Mesh mesh(test::shape_of(domain.roots, domain.periodic, 3), table, MPI_COMM_WORLD);
    test::put(mesh, tree, test::deal_out(Deal::scattered, tree, mesh.ranks(), random));
    Mesh before = test::whole_copy(mesh);
    test::set_noise(mesh, u, 1);
    test::set_noise(before, u, 1);
    const auto flux = [&](int level, int axis, const IntVec& face) {
      return random_flux(mesh, 4, level, axis, face);
    };
    FluxRegister fluxes(mesh);
    fluxes.prepare();
    store_fluxes(mesh, fluxes, flux);
    const double weight = -0.03;
    fluxes.correct(u, weight);
    Tally tally;
    for (int b = 0; b < mesh.size(); ++b) {
      const Block& block = mesh.block(b);
      const double* old = before.cells(u, before.local(block.leaf));
      test::for_all(mesh.layout(), [&](const IntVec& c) {
        double expected = old[mesh.layout().offset(c)];
        const double got = mesh.cells(u, b)[mesh.layout().offset(c)];
        const auto where = [&] { return test::text(block.index) + " cell " + test::text(c); };
        bool touched = false;
        for (int face = 0; face < FACES && test::is_interior(c, mesh.layout().n); ++face) {
          const int a = face_axis(face);
          if (across(mesh, b, face) != Neighbour::Kind::finer) continue;
          if (c[a] != (face_is_high(face) ? mesh.layout().n - 1 : 0)) continue;
          IntVec g = test::global_cell(block, c, mesh.layout().n);
          if (face_is_high(face)) ++g[a];
          const double diff = difference(flux, block.index.level, a, g);
          expected += weight * (face_is_high(face) ? diff : -diff) / block.dx;
          touched = true;
        }
        if (touched) {
          tally.near(got, expected, 1e-13, where);
        } else {
          tally.bits(got, expected, where);
        }
      });
    }
    EXPECT_TRUE(tally.result()) << test::text(domain.roots);
  }
}

TEST(MpiFluxRegister, NoDifferenceWhereFineAndCoarseAgree) {
  FieldTable table;
  const CellField u = table.add_cell(spec_of("u"));
  Random random(5);
  for (const Domain& domain : domains()) {
    const Tree tree = test::random_tree(random, domain.roots, domain.periodic, 3, kMaxLeaves);
    Mesh mesh(test::shape_of(domain.roots, domain.periodic, 3), table, MPI_COMM_WORLD);
    test::put(mesh, tree, test::deal_out(Deal::scattered, tree, mesh.ranks(), random));
    Mesh before = test::whole_copy(mesh);
    test::set_noise(mesh, u, 2);
    test::set_noise(before, u, 2);
    // Face means of a function that is linear along the face: 1/4, 3/4, ... of a coarse face, all of it
    // exact.
    FluxRegister fluxes(mesh);
    fluxes.prepare();
    store_fluxes(mesh, fluxes, [&](int level, int axis, const IntVec& face) {
      double value = 1 + axis;
      for (int a = 0; a < DIM; ++a)
        if (a != axis) value += (a + 2) * (face[a] + 0.5) * mesh.shape().dx(level);
      return value;
    });
    fluxes.correct(u, 0.3);
    Tally tally;
    for (int b = 0; b < mesh.size(); ++b) {
      const double* old = before.cells(u, before.local(mesh.block(b).leaf));
      test::for_interior(mesh.layout(), [&](const IntVec& c) {
        const std::ptrdiff_t o = mesh.layout().offset(c);
        tally.bits(mesh.cells(u, b)[o], old[o],
                   [&] { return test::text(mesh.block(b).index) + test::text(c); });
      });
    }
    EXPECT_TRUE(tally.result()) << test::text(domain.roots);
  }
}

TEST(MpiFluxRegister, SameBitsForAnyDistribution) {
  FieldTable table;
  const CellField u = table.add_cell(spec_of("u"));
  Random random(6);
  for (const Domain& domain : domains()) {
    const Tree tree = test::random_tree(random, domain.roots, domain.periodic, 3, kMaxLeaves);
    Mesh mesh(test::shape_of(domain.roots, domain.periodic, 3), table, MPI_COMM_WORLD);
    FluxRegister fluxes(mesh);
    for (const Deal deal : test::kDeals) {
      test::put(mesh, tree, test::deal_out(deal, tree, mesh.ranks(), random));
      Mesh whole = test::whole_copy(mesh);
      FluxRegister of_whole(whole);
      const auto flux = [&](int level, int axis, const IntVec& face) {
        return random_flux(mesh, 7, level, axis, face);
      };
      for (int step = 0; step < 2; ++step) {
        for (auto [m, r] : {std::pair(&mesh, &fluxes), std::pair(&whole, &of_whole)}) {
          if (step == 0) test::set_noise(*m, u, 3);
          r->prepare();
          store_fluxes(*m, *r, flux);
          r->correct(u, 0.07);
        }
      }
      Tally tally;
      for (int b = 0; b < mesh.size(); ++b) {
        const double* q = whole.cells(u, whole.local(mesh.block(b).leaf));
        test::for_interior(mesh.layout(), [&](const IntVec& c) {
          const std::ptrdiff_t o = mesh.layout().offset(c);
          tally.bits(mesh.cells(u, b)[o], q[o],
                     [&] { return test::text(mesh.block(b).index) + test::text(c); });
        });
      }
      EXPECT_TRUE(tally.result()) << test::text(domain.roots) << " deal " << static_cast<int>(deal);
    }
  }
}

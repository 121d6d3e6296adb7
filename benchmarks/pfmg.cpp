#include "pfmg.hpp"

#ifdef DENDRIFT_HAVE_HYPRE

#include <HYPRE.h>
#include <HYPRE_krylov.h>
#include <HYPRE_struct_ls.h>
#include <mpi.h>

#include "amr/loops.hpp"

namespace dendrift::bench {

struct Pfmg::Handles {
  HYPRE_StructGrid grid = nullptr;
  HYPRE_StructStencil stencil = nullptr;
  HYPRE_StructMatrix a = nullptr;
  HYPRE_StructVector b = nullptr, x = nullptr;
  HYPRE_StructSolver pfmg = nullptr, cg = nullptr;
  IntVec lo{}, hi{};
};

bool Pfmg::available() { return true; }

Pfmg::Pfmg(int n, const std::function<double(const RealVec&)>& beta, bool conjugate_gradients) : h_(std::make_unique<Handles>()) {
  HYPRE_Init();
  Handles& h = *h_;
  h.hi = filled(n - 1);
  HYPRE_StructGridCreate(MPI_COMM_SELF, DIM, &h.grid);
  HYPRE_StructGridSetExtents(h.grid, h.lo.data(), h.hi.data());
  HYPRE_StructGridAssemble(h.grid);
  // Symmetric: the centre and the upper neighbours.
  HYPRE_StructStencilCreate(DIM, DIM + 1, &h.stencil);
  IntVec offset{};
  HYPRE_StructStencilSetElement(h.stencil, 0, offset.data());
  for (int a = 0; a < DIM; ++a) {
    offset = {};
    offset[a] = 1;
    HYPRE_StructStencilSetElement(h.stencil, a + 1, offset.data());
  }
  HYPRE_StructMatrixCreate(MPI_COMM_SELF, h.grid, h.stencil, &h.a);
  HYPRE_StructMatrixSetSymmetric(h.a, 1);
  HYPRE_StructMatrixInitialize(h.a);
  const double dx = 1.0 / n, h2 = 1 / (dx * dx);
  std::vector<double> values;
  values.reserve(static_cast<std::size_t>(volume(filled(n))) * (DIM + 1));
  amr::for_each_cell({}, filled(n), [&](const IntVec& q) {
    std::array<double, DIM + 1> row{};
    for (int a = 0; a < DIM; ++a)
      for (const int side : {0, 1}) {
        RealVec face{};
        for (int d = 0; d < DIM; ++d) face[d] = (q[d] + (d == a ? side : 0.5)) * dx;
        const bool wall = side == 0 ? q[a] == 0 : q[a] == n - 1;
        const double k = h2 * beta(face);
        row[0] += wall ? 2 * k : k;
        if (side == 1 && !wall) row[static_cast<std::size_t>(a + 1)] = -k;
      }
    values.insert(values.end(), row.begin(), row.end());
  });
  std::array<HYPRE_Int, DIM + 1> entries{};
  for (std::size_t e = 0; e < entries.size(); ++e) entries[e] = static_cast<HYPRE_Int>(e);
  HYPRE_StructMatrixSetBoxValues(h.a, h.lo.data(), h.hi.data(), DIM + 1, entries.data(), values.data());
  HYPRE_StructMatrixAssemble(h.a);
  for (HYPRE_StructVector* v : {&h.b, &h.x}) {
    HYPRE_StructVectorCreate(MPI_COMM_SELF, h.grid, v);
    HYPRE_StructVectorInitialize(*v);
    HYPRE_StructVectorAssemble(*v);
  }
  HYPRE_StructPFMGCreate(MPI_COMM_SELF, &h.pfmg);
  HYPRE_StructPFMGSetMaxIter(h.pfmg, conjugate_gradients ? 1 : 100);
  HYPRE_StructPFMGSetRelaxType(h.pfmg, conjugate_gradients ? 2 : 3);  // red-black; symmetric where CG needs it
  HYPRE_StructPFMGSetNumPreRelax(h.pfmg, 1);
  HYPRE_StructPFMGSetNumPostRelax(h.pfmg, 1);
  HYPRE_StructPFMGSetSkipRelax(h.pfmg, 1);
  if (!conjugate_gradients) {
    HYPRE_StructPFMGSetup(h.pfmg, h.a, h.b, h.x);
    return;
  }
  HYPRE_StructPFMGSetTol(h.pfmg, 0);
  HYPRE_StructPFMGSetZeroGuess(h.pfmg);
  HYPRE_StructPCGCreate(MPI_COMM_SELF, &h.cg);
  HYPRE_StructPCGSetTwoNorm(h.cg, 1);
  HYPRE_StructPCGSetMaxIter(h.cg, 200);
  HYPRE_StructPCGSetPrecond(h.cg, HYPRE_StructPFMGSolve, HYPRE_StructPFMGSetup, h.pfmg);
  HYPRE_StructPCGSetup(h.cg, h.a, h.b, h.x);
}

Pfmg::~Pfmg() {
  if (h_->cg != nullptr) HYPRE_StructPCGDestroy(h_->cg);
  HYPRE_StructPFMGDestroy(h_->pfmg);
  HYPRE_StructVectorDestroy(h_->x);
  HYPRE_StructVectorDestroy(h_->b);
  HYPRE_StructMatrixDestroy(h_->a);
  HYPRE_StructStencilDestroy(h_->stencil);
  HYPRE_StructGridDestroy(h_->grid);
}

int Pfmg::solve(const std::vector<double>& f, std::vector<double>& x, double tolerance) {
  Handles& h = *h_;
  HYPRE_StructVectorSetBoxValues(h.b, h.lo.data(), h.hi.data(), const_cast<double*>(f.data()));
  HYPRE_StructVectorSetConstantValues(h.x, 0);
  HYPRE_Int iterations = 0;
  if (h.cg != nullptr) {
    HYPRE_StructPCGSetTol(h.cg, tolerance);
    HYPRE_StructPCGSolve(h.cg, h.a, h.b, h.x);
    HYPRE_StructPCGGetNumIterations(h.cg, &iterations);
  } else {
    HYPRE_StructPFMGSetTol(h.pfmg, tolerance);
    HYPRE_StructPFMGSolve(h.pfmg, h.a, h.b, h.x);
    HYPRE_StructPFMGGetNumIterations(h.pfmg, &iterations);
  }
  x.resize(f.size());
  HYPRE_StructVectorGetBoxValues(h.x, h.lo.data(), h.hi.data(), x.data());
  return static_cast<int>(iterations);
}

}  // namespace dendrift::bench

#else

namespace dendrift::bench {

struct Pfmg::Handles {};
bool Pfmg::available() { return false; }
Pfmg::Pfmg(int, const std::function<double(const RealVec&)>&, bool) {}
Pfmg::~Pfmg() = default;
int Pfmg::solve(const std::vector<double>&, std::vector<double>&, double) { return 0; }

}  // namespace dendrift::bench

#endif

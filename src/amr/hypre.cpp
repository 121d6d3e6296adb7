#include "amr/hypre.hpp"

#include <stdexcept>

#ifdef DENDRIFT_HAVE_HYPRE

#include <HYPRE.h>
#include <HYPRE_IJ_mv.h>
#include <HYPRE_krylov.h>
#include <HYPRE_parcsr_ls.h>

#include <algorithm>
#include <map>

namespace dendrift::amr {

namespace {

// hypre wants to be told once when it begins; it does not mind never to be told of the end.
void begin_once() {
  static const bool done = (HYPRE_Init(), true);
  static_cast<void>(done);
}

constexpr int RESTART = 30;

}  // namespace

struct HypreSolver::Handles {
  HYPRE_IJMatrix matrix = nullptr;
  HYPRE_IJVector b = nullptr, x = nullptr;
  HYPRE_ParCSRMatrix a = nullptr;
  HYPRE_ParVector pb = nullptr, px = nullptr;
  HYPRE_Solver krylov = nullptr, amg = nullptr;
  std::vector<HYPRE_BigInt> rows;
  Krylov method{};
};

bool HypreSolver::available() { return true; }

HypreSolver::HypreSolver(MPI_Comm comm, std::int64_t first, std::int64_t size, const std::vector<Entry>& entries, Krylov method)
    : h_(std::make_unique<Handles>()) {
  begin_once();
  Handles& h = *h_;
  h.method = method;
  const auto lo = static_cast<HYPRE_BigInt>(first), hi = static_cast<HYPRE_BigInt>(first + size - 1);
  HYPRE_IJMatrixCreate(comm, lo, hi, lo, hi, &h.matrix);
  HYPRE_IJMatrixSetObjectType(h.matrix, HYPRE_PARCSR);
  HYPRE_IJMatrixInitialize(h.matrix);
  std::vector<Entry> sorted = entries;
  std::stable_sort(sorted.begin(), sorted.end(), [](const Entry& p, const Entry& q) {
    return p.row != q.row ? p.row < q.row : p.column < q.column;
  });
  std::vector<HYPRE_BigInt> columns;
  std::vector<HYPRE_Complex> values;
  for (std::size_t i = 0; i < sorted.size();) {
    const std::int64_t row = sorted[i].row;
    columns.clear();
    values.clear();
    for (; i < sorted.size() && sorted[i].row == row; ++i) {
      const auto c = static_cast<HYPRE_BigInt>(sorted[i].column);
      if (!columns.empty() && columns.back() == c) {
        values.back() += sorted[i].value;
      } else {
        columns.push_back(c);
        values.push_back(sorted[i].value);
      }
    }
    auto count = static_cast<HYPRE_Int>(columns.size());
    const auto r = static_cast<HYPRE_BigInt>(row);
    HYPRE_IJMatrixAddToValues(h.matrix, 1, &count, &r, columns.data(), values.data());
  }
  HYPRE_IJMatrixAssemble(h.matrix);
  HYPRE_IJMatrixGetObject(h.matrix, reinterpret_cast<void**>(&h.a));
  for (HYPRE_IJVector* v : {&h.b, &h.x}) {
    HYPRE_IJVectorCreate(comm, lo, hi, v);
    HYPRE_IJVectorSetObjectType(*v, HYPRE_PARCSR);
    HYPRE_IJVectorInitialize(*v);
    HYPRE_IJVectorAssemble(*v);
  }
  HYPRE_IJVectorGetObject(h.b, reinterpret_cast<void**>(&h.pb));
  HYPRE_IJVectorGetObject(h.x, reinterpret_cast<void**>(&h.px));
  for (std::int64_t i = 0; i < size; ++i) h.rows.push_back(static_cast<HYPRE_BigInt>(first + i));

  HYPRE_BoomerAMGCreate(&h.amg);
  HYPRE_BoomerAMGSetPrintLevel(h.amg, 0);
  HYPRE_BoomerAMGSetCoarsenType(h.amg, 10);
  HYPRE_BoomerAMGSetInterpType(h.amg, 6);
  HYPRE_BoomerAMGSetRelaxType(h.amg, 8);  // symmetric
  HYPRE_BoomerAMGSetTol(h.amg, 0);
  HYPRE_BoomerAMGSetMaxIter(h.amg, 1);
  if (method == Krylov::conjugate_gradients) {
    HYPRE_ParCSRPCGCreate(comm, &h.krylov);
    HYPRE_PCGSetTwoNorm(h.krylov, 1);
    HYPRE_PCGSetPrecond(h.krylov, reinterpret_cast<HYPRE_PtrToSolverFcn>(HYPRE_BoomerAMGSolve),
                        reinterpret_cast<HYPRE_PtrToSolverFcn>(HYPRE_BoomerAMGSetup), h.amg);
    HYPRE_ParCSRPCGSetup(h.krylov, h.a, h.pb, h.px);
  } else {
    HYPRE_ParCSRFlexGMRESCreate(comm, &h.krylov);
    HYPRE_FlexGMRESSetKDim(h.krylov, RESTART);
    HYPRE_FlexGMRESSetPrecond(h.krylov, reinterpret_cast<HYPRE_PtrToSolverFcn>(HYPRE_BoomerAMGSolve),
                              reinterpret_cast<HYPRE_PtrToSolverFcn>(HYPRE_BoomerAMGSetup), h.amg);
    HYPRE_ParCSRFlexGMRESSetup(h.krylov, h.a, h.pb, h.px);
  }
}

HypreSolver::~HypreSolver() {
  if (h_->method == Krylov::conjugate_gradients) {
    HYPRE_ParCSRPCGDestroy(h_->krylov);
  } else {
    HYPRE_ParCSRFlexGMRESDestroy(h_->krylov);
  }
  HYPRE_BoomerAMGDestroy(h_->amg);
  HYPRE_IJVectorDestroy(h_->b);
  HYPRE_IJVectorDestroy(h_->x);
  HYPRE_IJMatrixDestroy(h_->matrix);
}

int HypreSolver::solve(std::span<const double> b, std::span<double> x, double tolerance, int max_iterations) {
  Handles& h = *h_;
  const auto count = static_cast<HYPRE_Int>(h.rows.size());
  HYPRE_IJVectorSetValues(h.b, count, h.rows.data(), b.data());
  HYPRE_IJVectorSetValues(h.x, count, h.rows.data(), x.data());
  HYPRE_Int iterations = 0;
  if (h.method == Krylov::conjugate_gradients) {
    HYPRE_PCGSetTol(h.krylov, tolerance);
    HYPRE_PCGSetMaxIter(h.krylov, max_iterations);
    HYPRE_ParCSRPCGSolve(h.krylov, h.a, h.pb, h.px);
    HYPRE_PCGGetNumIterations(h.krylov, &iterations);
  } else {
    HYPRE_FlexGMRESSetTol(h.krylov, tolerance);
    HYPRE_FlexGMRESSetMaxIter(h.krylov, max_iterations);
    HYPRE_ParCSRFlexGMRESSolve(h.krylov, h.a, h.pb, h.px);
    HYPRE_FlexGMRESGetNumIterations(h.krylov, &iterations);
  }
  HYPRE_ClearAllErrors();  // not converged: the caller looks at its own residual
  HYPRE_IJVectorGetValues(h.x, count, h.rows.data(), x.data());
  return static_cast<int>(iterations);
}

}  // namespace dendrift::amr

#else

namespace dendrift::amr {

struct HypreSolver::Handles {};
bool HypreSolver::available() { return false; }
HypreSolver::HypreSolver(MPI_Comm, std::int64_t, std::int64_t, const std::vector<Entry>&, Krylov) {
  throw std::runtime_error("this build has no hypre");
}
HypreSolver::~HypreSolver() = default;
int HypreSolver::solve(std::span<const double>, std::span<double>, double, int) { return 0; }

}  // namespace dendrift::amr

#endif

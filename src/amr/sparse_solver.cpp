#include "amr/sparse_solver.hpp"

#include <Eigen/SparseCholesky>
#include <stdexcept>

namespace dendrift::amr {

struct SparseSolver::Factors {
  Eigen::SimplicialLDLT<Eigen::SparseMatrix<double>> ldlt;
};

SparseSolver::SparseSolver() = default;
SparseSolver::~SparseSolver() = default;
SparseSolver::SparseSolver(SparseSolver&&) noexcept = default;
SparseSolver& SparseSolver::operator=(SparseSolver&&) noexcept = default;

void SparseSolver::factorize(int size, const std::vector<Entry>& entries) {
  std::vector<Eigen::Triplet<double>> list;
  list.reserve(entries.size());
  for (const Entry& e : entries) list.emplace_back(e.row, e.column, e.value);
  Eigen::SparseMatrix<double> matrix(size, size);
  matrix.setFromTriplets(list.begin(), list.end());
  for (int i = 0; i < size; ++i) matrix.coeffRef(i, i) *= 1 + LIFT;
  if (factors_ == nullptr || size_ != size) {
    factors_ = std::make_unique<Factors>();
    factors_->ldlt.analyzePattern(matrix);
  }
  size_ = size;
  factors_->ldlt.factorize(matrix);
  if (factors_->ldlt.info() != Eigen::Success) throw std::runtime_error("the matrix of the coarsest grid has no factors");
}

void SparseSolver::solve(std::span<double> x) const {
  if (factors_ == nullptr || static_cast<int>(x.size()) != size_) throw std::runtime_error("nothing factorized of that size");
  Eigen::Map<Eigen::VectorXd> v(x.data(), size_);
  v = factors_->ldlt.solve(v).eval();
}

}  // namespace dendrift::amr

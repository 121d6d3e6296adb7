/// \file
/// Krylov methods on vectors that are cut into pieces by blocks.
#pragma once

#include <functional>
#include <span>
#include <vector>

#include "amr/comm.hpp"

namespace dendrift::amr {

/// The pieces of a distributed vector, one a local block. Products are summed within a piece in order and over pieces
/// exactly, so they do not depend on ranks or threads.
struct Pieces {
  std::vector<std::ptrdiff_t> first{0};  ///< first[i] to first[i+1]: piece i
  std::vector<double> weight;            ///< of each entry in products, > 0
  bool alike = false;                    ///< weights within a piece are all the same
  MPI_Comm comm = MPI_COMM_NULL;

  std::size_t size() const { return static_cast<std::size_t>(first.back()); }
  /// Weighted products of v with some vectors. Collective.
  std::vector<double> products(const std::vector<double>& v, std::span<const std::vector<double>> with) const;
  double norm(const std::vector<double>& v) const;
};

struct GmresOptions {
  double tolerance = 1e-6;  ///< norm of the preconditioned residual over that of the solution
  int max_iterations = 200;
  int restart = 50;
};

struct GmresResult {
  int iterations = 0;
  double residual = 0;  ///< norm of the preconditioned residual, recomputed at the end
  bool converged = false;
};

/// Solves K x = b by corrections to x. residual(x, r): r = b - K x. apply(v, w): w = K v for a correction.
/// precondition(r): in place. Collective.
class Gmres {
 public:
  using Vector = std::vector<double>;
  std::function<void(const Vector&, Vector&)> residual, apply;
  std::function<void(Vector&)> precondition;

  /// `size(x)`: the norm that the residual is measured against.
  GmresResult solve(Vector& x, const Pieces& pieces, const GmresOptions& options,
                    const std::function<double(const Vector& x)>& size);

 private:
  std::vector<Vector> basis_;
};

struct GcrOptions {
  double tolerance = 1e-10;  ///< of the residual over the right-hand side, in the 2-norm and in the largest entry
  int max_iterations = 100;
  int directions = 2;        ///< earlier ones that a new one is made orthogonal to; what is kept is two vectors each
};

struct GcrResult {
  int iterations = 0;
  double residual = 0, largest = 0;  ///< over those of the right-hand side, as carried along
  bool converged = false;
};

/// Generalised conjugate residuals: as few vectors as one likes, for matrices nearly symmetric and preconditioners that
/// may change. The residual carried along is that of K itself, not of the preconditioned system.
class Gcr {
 public:
  using Vector = std::vector<double>;
  std::function<void(const Vector& r, Vector& z)> precondition;  ///< z = about K^-1 r
  std::function<void(const Vector& z, Vector& w)> apply;         ///< w = K z; called right after precondition

  /// r: b - K x, brought up to date as x is. b is measured by `norm` and `largest`. Collective.
  GcrResult solve(Vector& x, Vector& r, const Pieces& pieces, const GcrOptions& options, double norm, double largest);

 private:
  std::vector<Vector> z_, w_;
};

}  // namespace dendrift::amr

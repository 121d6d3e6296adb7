#include "amr/krylov.hpp"

#include <algorithm>
#include <cmath>

#include "amr/loops.hpp"

namespace dendrift::amr {

namespace {

// Squared shares of a new direction that the earlier ones leave: one that loses more digits is made orthogonal once more; and
// one of which only rounding is left is none.
constexpr double LITTLE = 1e-6, NOTHING = 1e-24;

std::size_t at(int i) { return static_cast<std::size_t>(i); }

}  // namespace

std::vector<double> Pieces::products(const std::vector<double>& v, std::span<const std::vector<double>> with) const {
  const int pieces = static_cast<int>(first.size()) - 1;
  const std::size_t count = with.size();
  std::vector<double> partial(at(pieces) * count);
  parallel_for(pieces, [&](int i) {
    const std::ptrdiff_t begin = first[at(i)], size = first[at(i) + 1] - begin;
    thread_local std::vector<double> weighted;
    weighted.resize(static_cast<std::size_t>(size));
    double* w = weighted.data();
    for (std::ptrdiff_t q = 0; q < size; ++q)
      w[q] = weight[static_cast<std::size_t>(begin + q)] * v[static_cast<std::size_t>(begin + q)];
    for (std::size_t k = 0; k < count; ++k) {
      const double* u = with[k].data() + begin;
      double sum = 0;
#pragma omp simd reduction(+ : sum)
      for (std::ptrdiff_t q = 0; q < size; ++q) sum += w[q] * u[q];
      partial[at(i) * count + k] = sum;
    }
  });
  std::vector<ExactSum> sums(count);
  for (int i = 0; i < pieces; ++i)
    for (std::size_t k = 0; k < count; ++k) sums[k].add(partial[at(i) * count + k]);
  return exact_sums(sums, comm);
}

double Pieces::norm(const std::vector<double>& v) const {
  return std::sqrt(products(v, std::span(&v, 1)).front());
}

GmresResult Gmres::solve(Vector& x, const Pieces& pieces, const GmresOptions& o,
                         const std::function<double(const Vector& x)>& size) {
  GmresResult result;
  const std::size_t n = pieces.size();
  const int m = o.restart;
  if (basis_.size() < at(m + 1)) basis_.resize(at(m + 1));
  for (Vector& v : basis_)
    if (v.size() != n) v.assign(n, 0.0);
  const auto scale = [&](double a, Vector& v) {
#pragma omp parallel for simd
    for (std::size_t q = 0; q < n; ++q) v[q] *= a;
  };
  // w -= sum of p_j basis_j, in one go over memory
  const auto subtract = [&](const std::vector<double>& p, int count, Vector& w) {
    constexpr std::size_t CHUNK = 2048;
    parallel_for(static_cast<int>((n + CHUNK - 1) / CHUNK), [&](int i) {
      const std::size_t begin = at(i) * CHUNK, end = std::min(n, begin + CHUNK);
      for (int j = 0; j < count; ++j) {
        const double *u = basis_[at(j)].data(), a = p[at(j)];
#pragma omp simd
        for (std::size_t q = begin; q < end; ++q) w[q] -= a * u[q];
      }
    });
  };
  while (true) {
    residual(x, basis_[0]);
    precondition(basis_[0]);
    const double beta = pieces.norm(basis_[0]);
    result.residual = beta;
    const double before = size(x);
    result.converged = beta <= o.tolerance * before;
    if (result.converged || result.iterations >= o.max_iterations || !std::isfinite(beta)) return result;
    scale(1 / beta, basis_[0]);
    std::vector<std::vector<double>> h;  // columns of the upper triangle after rotation
    std::vector<double> c, s, g{beta}, y;
    // Coefficients of the correction in the basis of the first k vectors.
    const auto solve_triangle = [&](int k) {
      y.assign(at(k), 0.0);
      for (int i = k - 1; i >= 0; --i) {
        double sum = g[at(i)];
        for (int j = i + 1; j < k; ++j) sum -= h[at(j)][at(i)] * y[at(j)];
        y[at(i)] = sum / h[at(i)][at(i)];
      }
    };
    int k = 0;
    for (; k < m && result.iterations < o.max_iterations; ++k) {
      ++result.iterations;
      Vector& w = basis_[at(k + 1)];
      apply(basis_[at(k)], w);
      precondition(w);
      std::vector<double> column(at(k + 2), 0.0);
      // Classical Gram-Schmidt, one sum over the ranks instead of k; again where so much was taken off that round-off
      // would show.
      double length = 0, whole = 0;
      constexpr double LOST = 1e-2;
      do {
        const std::vector<double> p = pieces.products(w, std::span(basis_.data(), at(k + 2)));
        whole = std::sqrt(p[at(k + 1)]);
        subtract(p, k + 1, w);
        for (int j = 0; j <= k; ++j) column[at(j)] += p[at(j)];
        length = pieces.norm(w);
      } while (length < LOST * whole && length > 1e-13 * beta);
      column[at(k + 1)] = length;
      for (int j = 0; j < k; ++j) {
        const double a = column[at(j)], b = column[at(j + 1)];
        column[at(j)] = c[at(j)] * a + s[at(j)] * b;
        column[at(j + 1)] = -s[at(j)] * a + c[at(j)] * b;
      }
      const double r = std::hypot(column[at(k)], column[at(k + 1)]);
      c.push_back(column[at(k)] / r);
      s.push_back(column[at(k + 1)] / r);
      column[at(k)] = r;
      h.push_back(std::move(column));
      g.push_back(-s[at(k)] * g[at(k)]);
      g[at(k)] *= c[at(k)];
      solve_triangle(k + 1);
      double correction = 0;
      for (const double q : y) correction += q * q;
      // From rest the solution is no larger than the correction; a warm start needs no correction to know its size.
      const double goal = o.tolerance * std::max(before, std::sqrt(correction));
      if (std::abs(g[at(k + 1)]) <= goal || length <= 1e-14 * beta) {
        ++k;
        break;
      }
      scale(1 / length, w);
    }
    solve_triangle(k);
    for (double& q : y) q = -q;
    subtract(y, k, x);
  }
}

GcrResult Gcr::solve(Vector& x, Vector& r, const Pieces& pieces, const GcrOptions& o, double norm, double largest) {
  GcrResult result;
  const std::size_t n = pieces.size(), slots = at(o.directions) + 1;
  const int count_of_pieces = static_cast<int>(pieces.first.size()) - 1;
  z_.resize(slots);
  w_.resize(slots);
  for (std::vector<Vector>* list : {&z_, &w_})
    for (Vector& v : *list) v.resize(n);
  std::vector<double> length(slots, 0.0);  // |w|^2
  std::vector<double> partial, largest_of(at(count_of_pieces));
  const auto measure = [&](const std::vector<double>& square) {
    double most = 0;
    for (const double m : largest_of) most = std::max(most, m);
    result.residual = std::sqrt(square.front()) / std::max(norm, 1e-300);
    result.largest = global_max(most, pieces.comm) / std::max(largest, 1e-300);
    result.converged = result.residual <= o.tolerance && result.largest <= o.tolerance;
  };
  const auto sum_up = [&](std::size_t count) {
    std::vector<ExactSum> sums(count);
    for (int i = 0; i < count_of_pieces; ++i)
      for (std::size_t k = 0; k < count; ++k) sums[k].add(partial[at(i) * count + k]);
    return exact_sums(sums, pieces.comm);
  };
  partial.resize(at(count_of_pieces));
  const auto norms_of_piece = [&](int i, std::size_t begin, std::size_t end) {
    const double *v = r.data(), *weight = pieces.weight.data();
    double sum = 0, most = 0;
    if (pieces.alike) {
#pragma omp simd reduction(+ : sum) reduction(max : most)
      for (std::size_t q = begin; q < end; ++q) {
        sum += v[q] * v[q];
        most = std::max(most, std::abs(v[q]));
      }
      sum *= weight[begin];
    } else {
#pragma omp simd reduction(+ : sum) reduction(max : most)
      for (std::size_t q = begin; q < end; ++q) {
        sum += weight[q] * v[q] * v[q];
        most = std::max(most, std::abs(v[q]));
      }
    }
    partial[at(i)] = sum;
    largest_of[at(i)] = most;
  };
  const auto for_pieces = [&](auto&& f) {
    parallel_for(count_of_pieces, [&](int i) {
      f(i, static_cast<std::size_t>(pieces.first[at(i)]), static_cast<std::size_t>(pieces.first[at(i) + 1]));
    });
  };
  for_pieces(norms_of_piece);
  measure(sum_up(1));
  std::size_t known = 0, now = 0;  // directions to heed; the slot that the next one takes
  while (!result.converged && result.iterations < o.max_iterations && std::isfinite(result.residual)) {
    ++result.iterations;
    precondition(r, z_[now]);
    apply(z_[now], w_[now]);
    std::vector<std::size_t> with;
    for (std::size_t k = 1; k <= known; ++k) with.push_back((now + slots - k) % slots);
    const std::size_t products = known + 2;
    std::vector<double> p, along(with.size());
    double square = 0, first = 0;  // what w keeps of its length, and had
    const auto subtract = [&](std::size_t begin, std::size_t end) {
      double *w = w_[now].data(), *z = z_[now].data();
      for (std::size_t k = 0; k < with.size(); ++k) {
        const double *u = w_[with[k]].data(), *v = z_[with[k]].data(), a = along[k];
#pragma omp simd
        for (std::size_t q = begin; q < end; ++q) {
          w[q] -= a * u[q];
          z[q] -= a * v[q];
        }
      }
    };
    // Twice where little is left: what rounding leaves of the others in w would spoil all that follows.
    for (bool again : {false, true}) {
      partial.resize(at(count_of_pieces) * products);
      for_pieces([&](int i, std::size_t begin, std::size_t end) {
        const double *w = w_[now].data(), *weight = pieces.weight.data();
        const auto product = [&](const double* v) {
          double sum = 0;
          if (pieces.alike) {
#pragma omp simd reduction(+ : sum)
            for (std::size_t q = begin; q < end; ++q) sum += w[q] * v[q];
            return sum * weight[begin];
          }
#pragma omp simd reduction(+ : sum)
          for (std::size_t q = begin; q < end; ++q) sum += weight[q] * w[q] * v[q];
          return sum;
        };
        double* to = partial.data() + at(i) * products;
        *to++ = product(w);
        *to++ = product(r.data());
        for (const std::size_t j : with) *to++ = product(w_[j].data());
      });
      p = sum_up(products);
      square = p[0];
      for (std::size_t k = 0; k < with.size(); ++k) {
        along[k] = p[k + 2] / length[with[k]];
        square -= along[k] * p[k + 2];
      }
      if (again) break;
      first = p[0];
      if (square > LITTLE * first) break;
      for_pieces([&](int, std::size_t begin, std::size_t end) { subtract(begin, end); });
    }
    if (!(square > NOTHING * first)) {  // nothing new: forget the rest
      if (known == 0) break;
      known = 0;
      continue;
    }
    length[now] = square;
    const double step = p[1] / square;  // r is orthogonal to the others already
    partial.resize(at(count_of_pieces));
    for_pieces([&](int i, std::size_t begin, std::size_t end) {
      subtract(begin, end);
      const double *w = w_[now].data(), *z = z_[now].data();
      double *px = x.data(), *pr = r.data();
#pragma omp simd
      for (std::size_t q = begin; q < end; ++q) {
        px[q] += step * z[q];
        pr[q] -= step * w[q];
      }
      norms_of_piece(i, begin, end);
    });
    measure(sum_up(1));
    known = std::min(known + 1, slots - 1);
    now = (now + 1) % slots;
  }
  return result;
}

}  // namespace dendrift::amr

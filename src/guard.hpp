/// \file
/// States that make no sense, and how a run goes on after one.
#pragma once

#include <optional>
#include <string>

#include "amr/mesh.hpp"
#include "io/config.hpp"

namespace dendrift {

/// Table [guard].
struct GuardOptions {
  int snapshot_every_steps = 20;
  int max_retries = 5;
  double max_c = 10;
  double max_solute_drift = 1e-6;
  double min_dt_tau0 = 1e-6;

  void declare(io::Schema& schema);
};

/// What is wrong with phi and c on any rank, and `when`: the first cell (by leaf) that is not finite or whose c/c_l is not
/// within -.1 and `max_c`, its block, and the cells around it. The same text on all ranks. Collective.
std::optional<std::string> find_fault(const amr::Mesh& mesh, amr::CellField psi, amr::CellField c, double max_c,
                                      const std::string& when);

/// How much smaller steps are than they might be, after failures.
class Caution {
 public:
  explicit Caution(int max_retries) : max_retries_(max_retries) {}

  double factor() const { return factor_; }    ///< of the largest step: 1 or a power of 1/2
  int failures() const { return failures_; }   ///< so far
  int tries() const { return tries_; }         ///< of the present failure

  /// After a failure of the step that starts at a time. False: that was once too often.
  bool may_retry(double time, std::int64_t step);
  /// The state is good. Once it is past the failure steps grow again, the later the more failures there were.
  void settle(double time, std::int64_t step);

 private:
  int max_retries_, failures_ = 0, tries_ = 0;
  double factor_ = 1, failed_at_ = -1;
  std::int64_t calm_until_ = 0, patience_ = 50;
};

}  // namespace dendrift

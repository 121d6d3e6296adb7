/// \file
/// What is done with a spoilt input or checkpoint, and what must come of it: taken, or refused with a message. Anything else is
/// thrown on, or crashes.
#pragma once

#include <cstddef>
#include <memory>
#include <string>
#include <vector>

#include "io/hdf5.hpp"
#include "mutate.hpp"

namespace dendrift::fuzz {

/// All bytes of a file.
std::string content_of(const std::string& path);

struct Verdict {
  bool accepted = false;
  std::string cause;  ///< of a refusal, in a few words
};

/// Reads, checks and derives as a run does before it makes its mesh. Throws std::logic_error if what is accepted holds numbers
/// that no run can use, or does not survive being written and read again.
Verdict try_input(const std::string& text);

/// Restarts from spoilt checkpoints. MPI must be there.
class Checkpoints {
 public:
  /// `folder`: where it may write.
  explicit Checkpoints(std::string folder);
  ~Checkpoints();
  /// A sound checkpoint, of a small scene with two crystals in a flow.
  const std::string& good() const { return good_; }
  /// Values of datasets, an attribute, or, `with_bookkeeping`, bytes anywhere: HDF5 1.10 itself crashes on some of those.
  std::string mutant(const std::string& from, bool with_bookkeeping, Chance& chance);
  /// Seals the bytes anew where `sealed`, so that the readers behind the seal see them.
  Verdict attempt(const std::string& bytes, bool sealed);

 private:
  struct Scene;
  struct Item {
    std::string name;
    io::FileRange range;
  };
  std::string change_values(std::string bytes, Chance& chance) const;
  std::string change_attribute(const std::string& bytes, Chance& chance) const;
  void mend_checksums(std::string& bytes) const;
  std::string folder_, path_, good_;
  std::unique_ptr<Scene> scene_;
  std::vector<Item> items_;             // datasets
  std::vector<io::FileRange> values_;   // those of fields
  std::uint64_t room_ = 0;
};

}  // namespace dendrift::fuzz

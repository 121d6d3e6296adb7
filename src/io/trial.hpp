/// \file
/// Work that may crash, tried in a process of its own.
#pragma once

#include <functional>
#include <string>

namespace dendrift::io {

/// How the work ended that was done in a child of this process: "" if it came to an end of its own, be it by an exception
/// (whoever repeats it here gets the same), otherwise what killed it, or that it took longer than `seconds` > 0.
/// The work must leave MPI alone. Nothing it changes in memory is seen here. Not collective; where the system gives no
/// second process nothing is tried, and the answer is "".
[[nodiscard]] std::string what_kills(const std::function<void()>& work, int seconds);

}  // namespace dendrift::io

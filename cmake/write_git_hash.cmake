# cmake -DSOURCE_DIR=... -DOUTPUT=... -P write_git_hash.cmake
# Defines DENDRIFT_GIT_HASH: the commit, with "-dirty" after it when tracked files differ from it, or "unknown".
# OUTPUT is touched only when its text changes.
set(hash "unknown")
find_program(GIT git)
if(GIT)
  # A release unpacked inside somebody else's checkout must not report that one's commit.
  execute_process(COMMAND ${GIT} rev-parse --show-prefix WORKING_DIRECTORY "${SOURCE_DIR}"
    RESULT_VARIABLE status OUTPUT_VARIABLE prefix OUTPUT_STRIP_TRAILING_WHITESPACE ERROR_QUIET)
  if(status EQUAL 0 AND prefix STREQUAL "")
    execute_process(COMMAND ${GIT} describe --always --abbrev=40 --match "" --dirty
      WORKING_DIRECTORY "${SOURCE_DIR}"
      RESULT_VARIABLE status OUTPUT_VARIABLE found OUTPUT_STRIP_TRAILING_WHITESPACE ERROR_QUIET)
    if(status EQUAL 0)
      set(hash "${found}")
    endif()
  endif()
endif()

set(text "#define DENDRIFT_GIT_HASH \"${hash}\"\n")
if(EXISTS "${OUTPUT}")
  file(READ "${OUTPUT}" old)
endif()
if(NOT "${old}" STREQUAL "${text}")
  file(WRITE "${OUTPUT}" "${text}")
endif()

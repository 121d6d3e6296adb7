# Options, and the compile and link flags of our own code (target dendrift_flags; never exported).
include(CheckCXXCompilerFlag)
include(CheckCXXSourceCompiles)
include(CheckLinkerFlag)
include(GNUInstallDirs)

option(DENDRIFT_WERROR "Treat compiler warnings as errors" ON)
option(DENDRIFT_TESTS "Build the tests (needs GoogleTest)" ${PROJECT_IS_TOP_LEVEL})
option(DENDRIFT_BENCHMARKS "Build dendrift-bench where Google Benchmark is found" ON)
set(DENDRIFT_ARCH "native" CACHE STRING "Value of -march in optimised builds; empty: the compiler's default")
set(DENDRIFT_VECTOR_WIDTH "auto" CACHE STRING
    "Preferred SIMD width in bits: auto (512 where DENDRIFT_ARCH has AVX-512), 128, 256, 512, or none")
set(DENDRIFT_SANITIZE "" CACHE STRING "Sanitizers: address, undefined, thread or address,undefined")

get_property(multi_config GLOBAL PROPERTY GENERATOR_IS_MULTI_CONFIG)
if(NOT CMAKE_BUILD_TYPE AND NOT multi_config)
  set(CMAKE_BUILD_TYPE Release CACHE STRING "Release, RelWithDebInfo or Debug" FORCE)
endif()

set(CMAKE_CXX_STANDARD 20)
set(CMAKE_CXX_STANDARD_REQUIRED ON)
set(CMAKE_CXX_EXTENSIONS OFF)
set(CMAKE_EXPORT_COMPILE_COMMANDS ON)

# --- optimised builds: what CMake sets (-O3), and no flag that changes the meaning of an expression
set(DENDRIFT_OPTIMIZE_FLAGS -fno-math-errno -fno-trapping-math)
if(DENDRIFT_ARCH)
  check_cxx_compiler_flag("-march=${DENDRIFT_ARCH}" DENDRIFT_HAS_ARCH_${DENDRIFT_ARCH})
  if(NOT DENDRIFT_HAS_ARCH_${DENDRIFT_ARCH})
    message(FATAL_ERROR "the compiler does not know -march=${DENDRIFT_ARCH}; set DENDRIFT_ARCH to one it "
                        "knows, or to nothing")
  endif()
  list(APPEND DENDRIFT_OPTIMIZE_FLAGS "-march=${DENDRIFT_ARCH}")
endif()

set(vector_width "${DENDRIFT_VECTOR_WIDTH}")
if(vector_width STREQUAL "auto")
  set(CMAKE_REQUIRED_FLAGS "${CMAKE_CXX_FLAGS}")
  if(DENDRIFT_ARCH)
    string(APPEND CMAKE_REQUIRED_FLAGS " -march=${DENDRIFT_ARCH}")
  endif()
  check_cxx_source_compiles("#ifndef __AVX512F__\n#error no AVX-512\n#endif\nint main() { return 0; }"
                            DENDRIFT_ARCH_HAS_AVX512_${DENDRIFT_ARCH})
  unset(CMAKE_REQUIRED_FLAGS)
  if(DENDRIFT_ARCH_HAS_AVX512_${DENDRIFT_ARCH})
    set(vector_width 512)
  else()
    set(vector_width none)
  endif()
endif()
if(NOT vector_width STREQUAL "none")
  check_cxx_compiler_flag("-mprefer-vector-width=${vector_width}" DENDRIFT_HAS_VECTOR_WIDTH_${vector_width})
  if(DENDRIFT_HAS_VECTOR_WIDTH_${vector_width})
    list(APPEND DENDRIFT_OPTIMIZE_FLAGS "-mprefer-vector-width=${vector_width}")
  elseif(NOT DENDRIFT_VECTOR_WIDTH STREQUAL "auto")
    message(FATAL_ERROR "the compiler does not know -mprefer-vector-width=${vector_width}; "
                        "DENDRIFT_VECTOR_WIDTH must be auto, none, 128, 256 or 512")
  endif()
endif()

# -Wrestrict: g++ 12 sees overlaps in std::string that are not there (GCC bug 105651).
set(DENDRIFT_WARNING_FLAGS -Wno-restrict -Wall -Wextra -Wpedantic -Wshadow -Wconversion -Wno-sign-conversion)
if(DENDRIFT_WERROR)
  list(APPEND DENDRIFT_WARNING_FLAGS -Werror)
endif()

# --- sanitizers
set(DENDRIFT_SANITIZE_FLAGS "")
if(DENDRIFT_SANITIZE)
  string(REPLACE "," ";" sanitizers "${DENDRIFT_SANITIZE}")
  foreach(name IN LISTS sanitizers)
    if(NOT name MATCHES "^(address|undefined|thread)$")
      message(FATAL_ERROR "DENDRIFT_SANITIZE: expected address, undefined or thread, found '${name}'")
    endif()
  endforeach()
  if("thread" IN_LIST sanitizers AND "address" IN_LIST sanitizers)
    message(FATAL_ERROR "DENDRIFT_SANITIZE: address and thread exclude each other")
  endif()
  list(JOIN sanitizers "," sanitizers)
  set(DENDRIFT_SANITIZE_FLAGS "-fsanitize=${sanitizers}" -fno-omit-frame-pointer -fno-sanitize-recover=all)
endif()

set(optimised "$<CONFIG:Release,RelWithDebInfo>")
add_library(dendrift_flags INTERFACE)
target_compile_features(dendrift_flags INTERFACE cxx_std_20)
target_compile_options(dendrift_flags INTERFACE
  ${DENDRIFT_WARNING_FLAGS} ${DENDRIFT_SANITIZE_FLAGS} "$<${optimised}:${DENDRIFT_OPTIMIZE_FLAGS}>")
target_compile_definitions(dendrift_flags INTERFACE "$<$<CONFIG:Debug>:_GLIBCXX_ASSERTIONS>")
target_link_options(dendrift_flags INTERFACE ${DENDRIFT_SANITIZE_FLAGS})

if(DENDRIFT_SANITIZE_FLAGS)
  target_sources(dendrift_flags INTERFACE
    "$<$<STREQUAL:$<TARGET_PROPERTY:TYPE>,EXECUTABLE>:${PROJECT_SOURCE_DIR}/cmake/sanitizer_dlclose.c>")
  target_link_options(dendrift_flags INTERFACE "LINKER:--export-dynamic-symbol=dlclose")
endif()

# Libraries that no symbol needs are not loaded: hypre alone brings dozens.
check_linker_flag(CXX "LINKER:--as-needed" DENDRIFT_HAS_AS_NEEDED)
if(DENDRIFT_HAS_AS_NEEDED)
  target_link_options(dendrift_flags INTERFACE "LINKER:--as-needed")
endif()

# The test suite.
#   tests/*/*_test.cpp    one GoogleTest program per dimension; every test is a ctest entry "2d.Suite.Name".
#                         Suites whose names begin with Mpi also run together on 2, 3 and 4 ranks.
#   tests/clients/*.py    run as `python3 FILE BUILD_DIR SOURCE_DIR`; a name that begins with _ is a helper;
#                         exit status 77 means skipped.
#   tests/fuzz/*.cpp      one program per dimension that spoils inputs and checkpoints; a short run of each is a test.
#   tests/mpi_tests.cmake read if it exists: calls of dendrift_mpi_test().
include(GoogleTest)

set(DENDRIFT_PYTHON "/usr/bin/python3" CACHE FILEPATH "Python with numpy, h5py, matplotlib and yt, for the tests")
set(DENDRIFT_TEST_TIMEOUT 2400 CACHE STRING "Limit of one test in seconds")
set(default_mpiexec_flags "")
if(MPI_C_LIBRARY_VERSION_STRING MATCHES "Open MPI" OR MPI_C_INCLUDE_DIRS MATCHES "openmpi")
  set(default_mpiexec_flags --oversubscribe --bind-to none)
endif()
set(DENDRIFT_MPIEXEC_FLAGS "${default_mpiexec_flags}" CACHE STRING "Flags of mpirun in the tests")

# Open MPI, as root in a container, several small jobs side by side: allow it, and start without a daemon and
# without looking for networks (0.03 s instead of 0.4 s per test). Other MPIs ignore these variables.
set(test_environment
  OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1
  OMPI_MCA_ess_singleton_isolated=1 OMPI_MCA_rmaps_base_oversubscribe=1
  OMPI_MCA_pml=ob1 OMPI_MCA_btl=self,vader OMPI_MCA_osc=^ucx
  OMPI_MCA_btl_vader_single_copy_mechanism=none
  OMP_WAIT_POLICY=passive OPENBLAS_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE=1 MPLBACKEND=Agg
  "ASAN_OPTIONS=fast_unwind_on_malloc=0"  # MPI is built without frame pointers
  "LSAN_OPTIONS=suppressions=${PROJECT_SOURCE_DIR}/cmake/lsan.supp:print_suppressions=0"
  "UBSAN_OPTIONS=print_stacktrace=1"
  "TSAN_OPTIONS=ignore_noninstrumented_modules=1:suppressions=${PROJECT_SOURCE_DIR}/cmake/tsan.supp")
set(test_directory "${PROJECT_BINARY_DIR}/tests")
file(MAKE_DIRECTORY "${test_directory}")

# dendrift_mpi_test(name ranks threads command [argument...])
# Registers `mpirun -n RANKS COMMAND ARGUMENT...` with OMP_NUM_THREADS=THREADS. COMMAND may be a target. These
# tests never share the machine with another one.
function(dendrift_mpi_test name ranks threads command)
  if(TARGET ${command})
    set(command "$<TARGET_FILE:${command}>")
  endif()
  add_test(NAME ${name} WORKING_DIRECTORY "${test_directory}"
    COMMAND "${MPIEXEC_EXECUTABLE}" ${MPIEXEC_NUMPROC_FLAG} ${ranks} ${DENDRIFT_MPIEXEC_FLAGS} ${command} ${ARGN})
  math(EXPR processors "${ranks} * ${threads}")
  set_tests_properties(${name} PROPERTIES
    ENVIRONMENT "${test_environment};OMP_NUM_THREADS=${threads}" LABELS mpi
    RUN_SERIAL ON PROCESSORS ${processors} TIMEOUT ${DENDRIFT_TEST_TIMEOUT})
endfunction()

file(GLOB test_sources CONFIGURE_DEPENDS "${PROJECT_SOURCE_DIR}/tests/*/*_test.cpp")
set(has_mpi_suites FALSE)
foreach(source IN LISTS test_sources)
  set_property(DIRECTORY APPEND PROPERTY CMAKE_CONFIGURE_DEPENDS "${source}")
  file(STRINGS "${source}" found REGEX "^(TYPED_)?TEST(_F|_P)?\\(Mpi")
  if(found)
    set(has_mpi_suites TRUE)
  endif()
endforeach()

if(test_sources)
  foreach(dim IN ITEMS 2 3)
    set(program dendrift_tests${dim}d)
    add_executable(${program} "${PROJECT_SOURCE_DIR}/tests/main.cpp" ${test_sources})
    target_include_directories(${program} PRIVATE "${PROJECT_SOURCE_DIR}/tests")
    target_compile_definitions(${program} PRIVATE
      "DENDRIFT_SOURCE_DIR=\"${PROJECT_SOURCE_DIR}\"" "DENDRIFT_BINARY_DIR=\"${PROJECT_BINARY_DIR}\"")
    target_link_libraries(${program} PRIVATE
      dendrift${dim}d_core dendrift_flags GTest::gtest GTest::gmock)
    gtest_discover_tests(${program} TEST_PREFIX "${dim}d." DISCOVERY_MODE PRE_TEST DISCOVERY_TIMEOUT 60
      WORKING_DIRECTORY "${test_directory}")
    if(has_mpi_suites)
      foreach(ranks IN ITEMS 2 3 4)
        set(name ${dim}d.mpi_suites_on_${ranks}_ranks)
        dendrift_mpi_test(${name} ${ranks} 1 ${program} "--gtest_filter=Mpi*:*/Mpi*")
        set_tests_properties(${name} PROPERTIES FAIL_REGULAR_EXPRESSION "Running 0 tests")
      endforeach()
    endif()
  endforeach()
  # gtest_discover_tests() passes on only the first variable of an ENVIRONMENT list; this file, which CTest reads
  # after its own, sets the properties of the tests found.
  file(WRITE "${PROJECT_BINARY_DIR}/gtest_properties.cmake"
    "foreach(name IN LISTS dendrift_tests2d_TESTS dendrift_tests3d_TESTS)\n"
    "  set_tests_properties(\"\${name}\" PROPERTIES LABELS gtest TIMEOUT ${DENDRIFT_TEST_TIMEOUT}\n"
    "    ENVIRONMENT [==[${test_environment};OMP_NUM_THREADS=2]==])\n"
    "endforeach()\n")
  set_property(DIRECTORY APPEND PROPERTY TEST_INCLUDE_FILES "${PROJECT_BINARY_DIR}/gtest_properties.cmake")
else()
  message(STATUS "no tests/*/*_test.cpp: no GoogleTest programs")
endif()

# tests/fuzz/README.md has the long runs. Inputs of the other dimension are the other program's.
set(fuzz_sources "${PROJECT_SOURCE_DIR}/tests/fuzz/targets.cpp" "${PROJECT_SOURCE_DIR}/tests/fuzz/mutate.cpp")
option(DENDRIFT_LIBFUZZER "Build libFuzzer programs (clang, and CMAKE_CXX_FLAGS=-fsanitize=fuzzer-no-link)" OFF)
foreach(dim IN ITEMS 2 3)
  set(program dendrift_fuzz${dim}d)
  add_executable(${program} "${PROJECT_SOURCE_DIR}/tests/fuzz/main.cpp" ${fuzz_sources})
  target_link_libraries(${program} PRIVATE dendrift${dim}d_core dendrift_flags)
  add_test(NAME ${dim}d.fuzz.inputs WORKING_DIRECTORY "${test_directory}"
    COMMAND ${program} inputs "${PROJECT_SOURCE_DIR}/inputs" mutants=1000)
  add_test(NAME ${dim}d.fuzz.checkpoint WORKING_DIRECTORY "${test_directory}"
    COMMAND ${program} checkpoint mutants=60 what=content)
  set_tests_properties(${dim}d.fuzz.inputs ${dim}d.fuzz.checkpoint PROPERTIES
    ENVIRONMENT "${test_environment};OMP_NUM_THREADS=1" LABELS fuzz TIMEOUT ${DENDRIFT_TEST_TIMEOUT})
  if(DENDRIFT_LIBFUZZER)
    foreach(what IN ITEMS inputs checkpoint)
      string(TOUPPER "DENDRIFT_FUZZ_${what}" macro)
      add_executable(dendrift_libfuzzer_${what}${dim}d "${PROJECT_SOURCE_DIR}/tests/fuzz/libfuzzer.cpp" ${fuzz_sources})
      target_compile_definitions(dendrift_libfuzzer_${what}${dim}d PRIVATE ${macro})
      target_link_libraries(dendrift_libfuzzer_${what}${dim}d PRIVATE dendrift${dim}d_core dendrift_flags)
      target_link_options(dendrift_libfuzzer_${what}${dim}d PRIVATE -fsanitize=fuzzer)
    endforeach()
  endif()
endforeach()

file(GLOB client_tests CONFIGURE_DEPENDS "${PROJECT_SOURCE_DIR}/tests/clients/*.py")
list(FILTER client_tests EXCLUDE REGEX "/_[^/]*$")
foreach(file IN LISTS client_tests)
  get_filename_component(name "${file}" NAME_WE)
  add_test(NAME clients.${name} WORKING_DIRECTORY "${test_directory}"
    COMMAND "${DENDRIFT_PYTHON}" "${file}" "${PROJECT_BINARY_DIR}" "${PROJECT_SOURCE_DIR}")
  set_tests_properties(clients.${name} PROPERTIES ENVIRONMENT "${test_environment};OMP_NUM_THREADS=1"
    LABELS clients RUN_SERIAL ON SKIP_RETURN_CODE 77 TIMEOUT ${DENDRIFT_TEST_TIMEOUT})
endforeach()

include("${PROJECT_SOURCE_DIR}/tests/mpi_tests.cmake" OPTIONAL)

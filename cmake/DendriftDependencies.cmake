# The libraries of dendrift, gathered in the interface target dendrift_libraries (exported).
# tools/setup_debian.sh lists the Debian packages; elsewhere point CMAKE_PREFIX_PATH, or HDF5_ROOT,
# HYPRE_ROOT, METIS_ROOT, at the installations.
find_package(MPI REQUIRED COMPONENTS C)  # also from C++ we call the C interface only
find_package(OpenMP REQUIRED COMPONENTS CXX)
find_package(HDF5Parallel REQUIRED)
find_package(METIS REQUIRED)
find_package(fmt REQUIRED)
find_package(CLI11 REQUIRED)
find_package(TomlPlusPlus REQUIRED)
find_package(spdlog QUIET)
find_package(Eigen3 3.3 REQUIRED NO_MODULE)
find_package(HYPRE QUIET)

add_library(dendrift_libraries INTERFACE)
add_library(dendrift::dendrift_libraries ALIAS dendrift_libraries)
target_compile_features(dendrift_libraries INTERFACE cxx_std_20)
target_compile_definitions(dendrift_libraries INTERFACE OMPI_SKIP_MPICXX MPICH_SKIP_MPICXX)
target_link_libraries(dendrift_libraries INTERFACE
  MPI::MPI_C OpenMP::OpenMP_CXX HDF5Parallel::HDF5 METIS::METIS
  Eigen3::Eigen fmt::fmt CLI11::CLI11 tomlplusplus::tomlplusplus)

# Without these the build goes on; DENDRIFT_HAVE_<NAME> tells the code what it has.
set(DENDRIFT_OPTIONAL_LIBRARIES "")
foreach(row IN ITEMS "HYPRE HYPRE::HYPRE" "spdlog spdlog::spdlog")
  string(REPLACE " " ";" row "${row}")
  list(GET row 0 package)
  list(GET row 1 target)
  string(TOUPPER "${package}" macro)
  if(${package}_FOUND)
    target_link_libraries(dendrift_libraries INTERFACE ${target})
    target_compile_definitions(dendrift_libraries INTERFACE DENDRIFT_HAVE_${macro}=1)
    list(APPEND DENDRIFT_OPTIONAL_LIBRARIES ${package})
  else()
    message(WARNING "${package} was not found: building without it (set ${package}_ROOT to use it)")
  endif()
endforeach()

if(DENDRIFT_TESTS)
  find_package(GTest QUIET)
  if(NOT GTest_FOUND)
    message(FATAL_ERROR "GoogleTest was not found: install libgtest-dev and libgmock-dev, or configure with "
                        "-DDENDRIFT_TESTS=OFF")
  endif()
endif()
if(DENDRIFT_BENCHMARKS)
  find_package(benchmark QUIET)
  if(NOT benchmark_FOUND)
    message(STATUS "Google Benchmark was not found: dendrift-bench will not be built")
    set(DENDRIFT_BENCHMARKS OFF)
  endif()
endif()

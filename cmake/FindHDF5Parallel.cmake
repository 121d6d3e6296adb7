# The MPI-parallel build of HDF5's C library: target HDF5Parallel::HDF5.
# In this order: HDF5_ROOT where it is set; Debian's pkg-config file for Open MPI (there serial and
# parallel builds live side by side under names of their own); CMake's FindHDF5 through h5pcc.
if(NOT TARGET HDF5Parallel::HDF5)
  add_library(HDF5Parallel::HDF5 INTERFACE IMPORTED)
  set(HDF5Parallel_SOURCE "")
  if(NOT HDF5_ROOT AND NOT DEFINED ENV{HDF5_ROOT})
    find_package(PkgConfig QUIET)
    if(PkgConfig_FOUND)
      pkg_check_modules(HDF5_OPENMPI QUIET IMPORTED_TARGET GLOBAL hdf5-openmpi)
      if(HDF5_OPENMPI_FOUND)
        target_link_libraries(HDF5Parallel::HDF5 INTERFACE PkgConfig::HDF5_OPENMPI)
        set(HDF5Parallel_SOURCE "pkg-config hdf5-openmpi")
        set(HDF5Parallel_VERSION "${HDF5_OPENMPI_VERSION}")
      endif()
    endif()
  endif()
  if(NOT HDF5Parallel_SOURCE)
    set(HDF5_PREFER_PARALLEL TRUE)
    find_package(HDF5 QUIET COMPONENTS C)
    if(HDF5_FOUND AND HDF5_IS_PARALLEL)
      target_link_libraries(HDF5Parallel::HDF5 INTERFACE hdf5::hdf5)
      set(HDF5Parallel_SOURCE "${HDF5_INCLUDE_DIRS}")
      set(HDF5Parallel_VERSION "${HDF5_VERSION}")
    elseif(HDF5_FOUND)
      set(HDF5Parallel_NOT_FOUND_MESSAGE "the HDF5 found in ${HDF5_INCLUDE_DIRS} is serial; set HDF5_ROOT to "
          "one built with MPI (Debian: libhdf5-openmpi-dev)")
      list(JOIN HDF5Parallel_NOT_FOUND_MESSAGE "" HDF5Parallel_NOT_FOUND_MESSAGE)
    endif()
  endif()
endif()

include(FindPackageHandleStandardArgs)
find_package_handle_standard_args(HDF5Parallel
  REQUIRED_VARS HDF5Parallel_SOURCE VERSION_VAR HDF5Parallel_VERSION
  REASON_FAILURE_MESSAGE "${HDF5Parallel_NOT_FOUND_MESSAGE}")

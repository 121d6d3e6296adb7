# hypre: target HYPRE::HYPRE, from its own CMake package or from header and library (HYPRE_ROOT is honoured).
find_package(HYPRE QUIET CONFIG)
if(NOT TARGET HYPRE::HYPRE)
  find_path(HYPRE_INCLUDE_DIR HYPRE.h PATH_SUFFIXES hypre)
  find_library(HYPRE_LIBRARY NAMES HYPRE hypre)
  mark_as_advanced(HYPRE_INCLUDE_DIR HYPRE_LIBRARY)
  if(HYPRE_INCLUDE_DIR AND HYPRE_LIBRARY)
    add_library(HYPRE::HYPRE UNKNOWN IMPORTED)
    set_target_properties(HYPRE::HYPRE PROPERTIES
      IMPORTED_LOCATION "${HYPRE_LIBRARY}" INTERFACE_INCLUDE_DIRECTORIES "${HYPRE_INCLUDE_DIR}")
  endif()
endif()
if(TARGET HYPRE::HYPRE)
  set(HYPRE_TARGET HYPRE::HYPRE)
endif()

include(FindPackageHandleStandardArgs)
find_package_handle_standard_args(HYPRE REQUIRED_VARS HYPRE_TARGET)

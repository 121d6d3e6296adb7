# cmake --install: programs, libraries, headers, tools, inputs, and the package that find_package(dendrift) finds.
include(CMakePackageConfigHelpers)

set(package_dir "${CMAKE_INSTALL_LIBDIR}/cmake/dendrift")
set(programs dendrift dendrift2d dendrift3d)
if(TARGET dendrift_bench2d)
  list(APPEND programs dendrift_bench2d dendrift_bench3d)
  install(FILES "${PROJECT_BINARY_DIR}/dendrift-bench" DESTINATION "${CMAKE_INSTALL_BINDIR}")
endif()
install(TARGETS ${programs} RUNTIME DESTINATION "${CMAKE_INSTALL_BINDIR}")
install(TARGETS dendrift2d_core dendrift3d_core dendrift_libraries dendrift_build_info
  EXPORT dendriftTargets ARCHIVE DESTINATION "${CMAKE_INSTALL_LIBDIR}")

install(DIRECTORY "${PROJECT_SOURCE_DIR}/src/" "${DENDRIFT_GENERATED_DIR}/"
  DESTINATION "${CMAKE_INSTALL_INCLUDEDIR}/dendrift" FILES_MATCHING PATTERN "*.hpp" PATTERN "*.h")
install(DIRECTORY "${PROJECT_SOURCE_DIR}/tools" "${PROJECT_SOURCE_DIR}/inputs"
  DESTINATION "${CMAKE_INSTALL_DATADIR}/dendrift" USE_SOURCE_PERMISSIONS PATTERN "__pycache__" EXCLUDE)
install(FILES "${PROJECT_SOURCE_DIR}/LICENSE" DESTINATION "${CMAKE_INSTALL_DOCDIR}")

install(EXPORT dendriftTargets NAMESPACE dendrift:: DESTINATION "${package_dir}")
configure_package_config_file("${PROJECT_SOURCE_DIR}/cmake/dendriftConfig.cmake.in"
  "${PROJECT_BINARY_DIR}/dendriftConfig.cmake" INSTALL_DESTINATION "${package_dir}")
write_basic_package_version_file("${PROJECT_BINARY_DIR}/dendriftConfigVersion.cmake"
  COMPATIBILITY SameMinorVersion)
install(FILES "${PROJECT_BINARY_DIR}/dendriftConfig.cmake" "${PROJECT_BINARY_DIR}/dendriftConfigVersion.cmake"
  cmake/FindHDF5Parallel.cmake cmake/FindHYPRE.cmake cmake/FindMETIS.cmake cmake/FindTomlPlusPlus.cmake
  DESTINATION "${package_dir}")

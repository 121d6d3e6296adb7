# toml++: target tomlplusplus::tomlplusplus, from its CMake package, else the bare header.
find_package(tomlplusplus QUIET CONFIG)
if(NOT TARGET tomlplusplus::tomlplusplus)
  find_path(TomlPlusPlus_INCLUDE_DIR toml++/toml.h)
  mark_as_advanced(TomlPlusPlus_INCLUDE_DIR)
  if(TomlPlusPlus_INCLUDE_DIR)
    add_library(tomlplusplus::tomlplusplus INTERFACE IMPORTED)
    set_target_properties(tomlplusplus::tomlplusplus PROPERTIES
      INTERFACE_INCLUDE_DIRECTORIES "${TomlPlusPlus_INCLUDE_DIR}")
  endif()
endif()
if(TARGET tomlplusplus::tomlplusplus)
  set(TomlPlusPlus_TARGET tomlplusplus::tomlplusplus)
endif()

include(FindPackageHandleStandardArgs)
find_package_handle_standard_args(TomlPlusPlus REQUIRED_VARS TomlPlusPlus_TARGET)

# build_info.hpp: what was built, from which commit, how. Configured once; the commit is asked for at every
# build by the target dendrift_git_hash, and only what includes build_info.hpp is compiled anew when it moves.
set(DENDRIFT_GENERATED_DIR "${PROJECT_BINARY_DIR}/generated")
set(DENDRIFT_COMPILER "${CMAKE_CXX_COMPILER_ID} ${CMAKE_CXX_COMPILER_VERSION}")

string(TOUPPER "${CMAKE_BUILD_TYPE}" build_type_upper)
set(flags ${CMAKE_CXX_FLAGS} ${CMAKE_CXX_FLAGS_${build_type_upper}})
if(CMAKE_BUILD_TYPE MATCHES "^(Release|RelWithDebInfo)$")
  list(APPEND flags ${DENDRIFT_OPTIMIZE_FLAGS})
endif()
list(APPEND flags ${OpenMP_CXX_FLAGS} ${DENDRIFT_SANITIZE_FLAGS})
list(JOIN flags " " DENDRIFT_FLAGS)
string(REGEX REPLACE " +" " " DENDRIFT_FLAGS "${DENDRIFT_FLAGS}")
string(STRIP "${DENDRIFT_FLAGS}" DENDRIFT_FLAGS)
foreach(name IN ITEMS DENDRIFT_COMPILER DENDRIFT_FLAGS)
  string(REPLACE "\\" "\\\\" ${name} "${${name}}")
  string(REPLACE "\"" "\\\"" ${name} "${${name}}")
endforeach()

configure_file("${PROJECT_SOURCE_DIR}/cmake/build_info.hpp.in" "${DENDRIFT_GENERATED_DIR}/build_info.hpp" @ONLY)

add_custom_target(dendrift_git_hash
  COMMAND ${CMAKE_COMMAND} -DSOURCE_DIR=${PROJECT_SOURCE_DIR}
          -DOUTPUT=${DENDRIFT_GENERATED_DIR}/build_git_hash.hpp
          -P ${PROJECT_SOURCE_DIR}/cmake/write_git_hash.cmake
  BYPRODUCTS "${DENDRIFT_GENERATED_DIR}/build_git_hash.hpp"
  COMMENT "Asking git for the commit" VERBATIM)

add_library(dendrift_build_info INTERFACE)
target_include_directories(dendrift_build_info INTERFACE
  "$<BUILD_INTERFACE:${DENDRIFT_GENERATED_DIR}>"
  "$<INSTALL_INTERFACE:${CMAKE_INSTALL_INCLUDEDIR}/dendrift>")

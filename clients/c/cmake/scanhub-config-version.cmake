# Version of the package. Before 1.0, a version is compatible with the versions that have the same first two numbers.
# install.sh writes the version into the next line. In the sources, the version is read from Cargo.toml.
set(PACKAGE_VERSION "@VERSION@")
if(NOT PACKAGE_VERSION MATCHES "^[0-9]")
    file(STRINGS "${CMAKE_CURRENT_LIST_DIR}/../../../Cargo.toml" _scanhub_version
        REGEX "^version = \"[^\"]*\"" LIMIT_COUNT 1)
    string(REGEX REPLACE "^version = \"([^\"]*)\".*" "\\1" PACKAGE_VERSION "${_scanhub_version}")
    unset(_scanhub_version)
endif()
string(REGEX MATCH "^[0-9]+\\.[0-9]+" _scanhub_series "${PACKAGE_VERSION}")
if(PACKAGE_FIND_VERSION STREQUAL PACKAGE_VERSION)
    set(PACKAGE_VERSION_EXACT TRUE)
    set(PACKAGE_VERSION_COMPATIBLE TRUE)
elseif(NOT PACKAGE_FIND_VERSION VERSION_GREATER PACKAGE_VERSION
        AND "${PACKAGE_FIND_VERSION_MAJOR}.${PACKAGE_FIND_VERSION_MINOR}" STREQUAL _scanhub_series)
    set(PACKAGE_VERSION_COMPATIBLE TRUE)
else()
    set(PACKAGE_VERSION_COMPATIBLE FALSE)
endif()
unset(_scanhub_series)

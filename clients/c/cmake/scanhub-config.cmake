# Package for find_package(scanhub 0.1 CONFIG): the targets scanhub::scanhub (shared library) and
# scanhub::scanhub_static. The package works below any prefix into which install.sh installed it, even if the prefix was
# moved. It also works in the sources.
#
#     cmake -B build -DCMAKE_PREFIX_PATH=PREFIX
#     cmake -B build -Dscanhub_DIR=SCANHUB/clients/c/cmake
#
# In the sources, scanhub_LIBRARY_DIR is the directory of the built libraries, target/release by default.

if(EXISTS "${CMAKE_CURRENT_LIST_DIR}/../include/scanhub/attach.h")
    get_filename_component(_scanhub_include "${CMAKE_CURRENT_LIST_DIR}/../include" ABSOLUTE)
    get_filename_component(_scanhub_library_dir "${CMAKE_CURRENT_LIST_DIR}/../../../target/release" ABSOLUTE)
    if(scanhub_LIBRARY_DIR)
        set(_scanhub_library_dir "${scanhub_LIBRARY_DIR}")
    elseif(DEFINED ENV{CARGO_TARGET_DIR})
        set(_scanhub_library_dir "$ENV{CARGO_TARGET_DIR}/release")
    endif()
    set(_scanhub_shared "${_scanhub_library_dir}/libscanhub.so")
    if(EXISTS "${_scanhub_shared}")
        # The loader searches for the library by its soname. Cargo makes no file of this name.
        set(_scanhub_link "${CMAKE_BINARY_DIR}/scanhub/libscanhub.so.0")
        file(MAKE_DIRECTORY "${CMAKE_BINARY_DIR}/scanhub")
        execute_process(COMMAND "${CMAKE_COMMAND}" -E create_symlink "${_scanhub_shared}" "${_scanhub_link}")
        set(_scanhub_shared "${_scanhub_link}")
    endif()
else()
    get_filename_component(_scanhub_library_dir "${CMAKE_CURRENT_LIST_DIR}/../.." ABSOLUTE)
    get_filename_component(_scanhub_include "${_scanhub_library_dir}/../include" ABSOLUTE)
    set(_scanhub_shared "${_scanhub_library_dir}/libscanhub.so.0")
endif()
set(_scanhub_static "${_scanhub_library_dir}/libscanhub.a")

if(NOT TARGET scanhub::scanhub AND EXISTS "${_scanhub_shared}")
    add_library(scanhub::scanhub SHARED IMPORTED)
    set_target_properties(scanhub::scanhub PROPERTIES
        IMPORTED_LOCATION "${_scanhub_shared}"
        IMPORTED_SONAME libscanhub.so.0
        INTERFACE_INCLUDE_DIRECTORIES "${_scanhub_include}")
endif()
if(NOT TARGET scanhub::scanhub_static AND EXISTS "${_scanhub_static}")
    add_library(scanhub::scanhub_static STATIC IMPORTED)
    set_target_properties(scanhub::scanhub_static PROPERTIES
        IMPORTED_LOCATION "${_scanhub_static}"
        IMPORTED_LINK_INTERFACE_LANGUAGES C
        INTERFACE_INCLUDE_DIRECTORIES "${_scanhub_include}"
        # The same libraries as in scanhub.pc.in.
        INTERFACE_LINK_LIBRARIES "gcc_s;util;rt;pthread;m;dl;c")
endif()
if(NOT TARGET scanhub::scanhub AND NOT TARGET scanhub::scanhub_static)
    set(scanhub_FOUND FALSE)
    set(scanhub_NOT_FOUND_MESSAGE
        "no libscanhub in ${_scanhub_library_dir}; run cargo build --release -p scanhub-c, or set scanhub_LIBRARY_DIR")
endif()
unset(_scanhub_include)
unset(_scanhub_library_dir)
unset(_scanhub_link)
unset(_scanhub_shared)
unset(_scanhub_static)

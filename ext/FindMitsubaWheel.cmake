# Finds Mitsuba, Dr.Jit and nanobind where pip put them.
#
# Needs Python_EXECUTABLE. Defines the targets
#   Mitsuba::abi      headers, definitions and flags that code sharing types with the
#                     wheel's libraries must be compiled with
#   Mitsuba::mitsuba  the same, and the libraries
# and the variables
#   MitsubaWheel_VERSION       Mitsuba's release
#   MitsubaWheel_VARIANTS      the variants that the wheel was built with
#   MitsubaWheel_REQUIREMENTS  the pinned versions, as arguments for pip
#   MitsubaWheel_nanobind_DIR  the folder of nanobind's CMake package

# The pins are written down once, in pyproject.toml. An exact version matters: the classes
# of Mitsuba have no stable ABI, and nanobind's reference counter is a part of it.
file(STRINGS "${PROJECT_SOURCE_DIR}/pyproject.toml" pyproject)
set(MitsubaWheel_REQUIREMENTS "")
foreach(package IN ITEMS mitsuba drjit nanobind)
  if(NOT pyproject MATCHES "\"${package}==([0-9.]+)\"")
    message(FATAL_ERROR "pyproject.toml does not pin ${package} to a version.")
  endif()
  set(required_${package} "${CMAKE_MATCH_1}")
  string(APPEND MitsubaWheel_REQUIREMENTS " ${package}==${CMAKE_MATCH_1}")
endforeach()
string(STRIP "${MitsubaWheel_REQUIREMENTS}" MitsubaWheel_REQUIREMENTS)

# Packages are located and not imported: importing Mitsuba would load its libraries and
# look for a GPU. Nothing is cached, since an isolated build has new paths every time.
foreach(package IN ITEMS mitsuba drjit nanobind)
  execute_process(
    COMMAND "${Python_EXECUTABLE}" -c "
import importlib.metadata, importlib.util
print(importlib.metadata.version('${package}'))
print(importlib.util.find_spec('${package}').submodule_search_locations[0])"
    OUTPUT_VARIABLE answer
    OUTPUT_STRIP_TRAILING_WHITESPACE
    ERROR_QUIET
    RESULT_VARIABLE failed)
  if(failed)
    set(problem "is not installed")
  else()
    string(REPLACE "\n" ";" answer "${answer}")
    list(GET answer 0 found_${package})
    list(GET answer 1 dir_${package})
    set(problem "has version ${found_${package}}")
  endif()
  if(failed OR NOT found_${package} VERSION_EQUAL required_${package})
    message(FATAL_ERROR
      "manylights needs ${package} ${required_${package}}, but it ${problem} for "
      "${Python_EXECUTABLE}. Type\n"
      "  ${Python_EXECUTABLE} -m pip install ${MitsubaWheel_REQUIREMENTS}")
  endif()
endforeach()
set(MitsubaWheel_VERSION "${found_mitsuba}")
message(STATUS "Mitsuba ${found_mitsuba}: ${dir_mitsuba}")

set(MitsubaWheel_nanobind_DIR "${dir_nanobind}/cmake")

file(STRINGS "${dir_mitsuba}/config.py" variants REGEX "^MI_VARIANTS")
string(REGEX MATCHALL "'[a-z_]+'" variants "${variants}")
string(REPLACE "'" "" MitsubaWheel_VARIANTS "${variants}")

# Dr.Jit's own package can be moved: it defines drjit, drjit-core, drjit-extra, nanothread.
set(drjit_DIR "${dir_drjit}/cmake/drjit")
find_package(drjit CONFIG REQUIRED QUIET)

# Include directories of imported targets count as system headers: our warnings stay ours.
add_library(Mitsuba::abi INTERFACE IMPORTED)
target_link_libraries(Mitsuba::abi INTERFACE drjit)
target_compile_features(Mitsuba::abi INTERFACE cxx_std_17)
target_include_directories(Mitsuba::abi INTERFACE
  "${dir_mitsuba}/include"
  "${dir_nanobind}/include"
  "${dir_nanobind}/ext/robin_map/include"
  "${CMAKE_CURRENT_LIST_DIR}")
# These choose members of Mitsuba's classes and must be those of the wheel.
target_compile_definitions(Mitsuba::abi INTERFACE MI_ENABLE_EMBREE=1 MI_ENABLE_AUTODIFF=1)
foreach(backend IN ITEMS LLVM CUDA METAL)
  string(TOLOWER "${backend}" prefix)
  if(MitsubaWheel_VARIANTS MATCHES "${prefix}_")
    target_compile_definitions(Mitsuba::abi INTERFACE MI_ENABLE_${backend}=1)
  endif()
endforeach()
target_compile_options(Mitsuba::abi INTERFACE -fno-strict-aliasing)
# Mitsuba's macros put names of files into messages: not where this machine has them.
foreach(package IN ITEMS mitsuba drjit nanobind)
  target_compile_options(Mitsuba::abi INTERFACE
    "-ffile-prefix-map=${dir_${package}}=${package}")
endforeach()
target_compile_options(Mitsuba::abi INTERFACE "-ffile-prefix-map=${PROJECT_SOURCE_DIR}/=")
# Nobody asks for errno or floating point exceptions, and both forbid short code: 1 % less
# instructions of scalar variants, the same numbers.
target_compile_options(Mitsuba::abi INTERFACE -fno-math-errno -fno-trapping-math)
# The wheel's size and alignment of arrays are those of AVX2. Other architectures have one
# baseline, and GCC does not know this name there.
if(CMAKE_SYSTEM_PROCESSOR MATCHES "^(x86_64|amd64|AMD64)$")
  target_compile_options(Mitsuba::abi INTERFACE -march=haswell)
endif()

add_library(Mitsuba::libmitsuba SHARED IMPORTED)
set_target_properties(Mitsuba::libmitsuba PROPERTIES
  IMPORTED_LOCATION "${dir_mitsuba}/libmitsuba${CMAKE_SHARED_LIBRARY_SUFFIX}"
  # Libraries that libmitsuba itself needs: linkers want to see them, we do not call them.
  IMPORTED_LINK_DEPENDENT_LIBRARIES "drjit-core;drjit-extra;nanothread")

add_library(Mitsuba::mitsuba INTERFACE IMPORTED)
target_link_libraries(Mitsuba::mitsuba INTERFACE
  Mitsuba::abi Mitsuba::libmitsuba drjit-extra drjit-core nanothread)

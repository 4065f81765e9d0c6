#pragma once

/**
 * The parameter `aovs` of both integrators: film channels that describe what a camera ray meets
 * first, with the grammar and the channel names of Mitsuba's `aov`. Plain C++.
 */

#include <mitsuba/core/properties.h>
#include <string>
#include <string_view>
#include <vector>

namespace manylights {

/// In the order of the texts of the parameter (parameter_table.cpp)
enum class AovType {
    Albedo,
    Depth,
    Position,
    UV,
    GeometricNormal,
    ShadingNormal,
    DpDu,
    DpDv,
    DuvDx,
    DuvDy,
    PrimIndex,
    ShapeIndex,
    Emission
};

/// One of a list, of one to three channels
struct Aov {
    std::string name;
    AovType type;
};

/// Read and check the parameter; none if it is not given
std::vector<Aov> read_aovs(const mitsuba::Properties &props);

/// Names of the film's channels, in the order of the list
std::vector<std::string> channel_names(const std::vector<Aov> &aovs);

/// The list as users write it
std::string to_string(const std::vector<Aov> &aovs);

} // namespace manylights

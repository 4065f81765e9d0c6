#pragma once

/**
 * The values of the parameters, shared by all integrators. Names, ranges and defaults are in
 * parameter_table.cpp.
 */

#include "group_names.h"
#include "parameter_table.h"
#include <cstdint>
#include <mitsuba/core/properties.h>
#include <string>
#include <vector>

namespace manylights {

/// Above it all lights are visited
constexpr float kMaxSplittingRate = 1 << 10;

/// What decides whether a node is split: the talk's two functions, or the variance
enum class SplitFunction { Near, Far, Variance };

/// Is the lights' visibility learnt in each rendering, and is it kept for the next one?
enum class LearnVisibility { No, Yes, Keep };

/// See the documentation of the plugin manylights_direct
struct SamplingParameters {
    Plugins plugin;
    Method method;
    SplitFunction split_function;
    float splitting_rate;
    /// May paths have more vertices than one? (strategy.h)
    bool several_bounces = false;
    uint32_t reservoirs, shadow_rays, bsdf_samples;
    /// Are the candidates and the visited nodes counted, in film channels?
    bool counts;
    LearnVisibility learn_visibility;
    /// Groups of lights that have film layers of their own
    GroupNames light_groups;

    /// Does it walk the binary tree, and split its nodes one by one?
    bool splits_nodes() const {
        return method == Method::Talk || method == Method::AdaptiveSplitting;
    }
    /// Does each candidate get a shadow ray?
    bool traces_all() const { return method == Method::AdaptiveSplitting; }
    /// Is every one of so many lights a candidate, without a tree?
    bool considers_all(uint32_t lights) const {
        return lights <= reservoirs || splitting_rate > kMaxSplittingRate;
    }
};

/// Read and check the parameters; throws with the name, the value and what is allowed
SamplingParameters read_parameters(const mitsuba::Properties &props);

/// The same for paths, where one direction is sampled at each vertex (no `bsdf_samples`)
SamplingParameters read_path_parameters(const mitsuba::Properties &props);

/// Names of the film channels with counts
std::vector<std::string> count_channels(const SamplingParameters &params);

/// "name = value" lines of what has an effect
std::string to_string(const SamplingParameters &params);

} // namespace manylights

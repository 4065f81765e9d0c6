#pragma once

/**
 * The values of the parameters, shared by all integrators. Names, ranges and defaults are in
 * parameter_table.cpp.
 */

#include "group_names.h"
#include "parameter_table.h"
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <mitsuba/core/properties.h>
#include <string>
#include <vector>

namespace manylights {

/// K above which systematic sampling would lose the fraction of a float: visit all lights
constexpr float kMaxExpectedCandidates = 1 << 14;
/// K for a splitting rate of 1: at the first vertex, how much less at each that follows, and at
/// least. Rays that lead to the vertices of a path cost as much as shadow rays, and light that has
/// been reflected is dimmer: fewer pay on paths, and fewer from vertex to vertex.
struct Effort {
    float first, less, least;
};
constexpr Effort kOneBounce{ 16.f, 0.f, 16.f }, kSeveralBounces{ 6.f, 2.f, 2.f };

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
    Effort effort = kOneBounce;
    uint32_t reservoirs, shadow_rays, bsdf_samples;
    /// Are the candidates and the visited nodes counted, in film channels?
    bool counts;
    LearnVisibility learn_visibility;
    /// Groups of lights that have film layers of their own
    GroupNames light_groups;

    /// Expected number of candidates K at the first vertex, at least one
    float expected_candidates() const {
        return std::max(1.f, effort.first * splitting_rate);
    }
    /// Upper limit of the number of candidates
    float most_candidates() const {
        return splits_nodes() ? std::numeric_limits<float>::infinity()
                              : std::ceil(expected_candidates());
    }
    /// Does it walk the binary tree, and split its nodes one by one?
    bool splits_nodes() const {
        return method == Method::Talk || method == Method::AdaptiveSplitting;
    }
    /// Does each candidate get a shadow ray?
    bool traces_all() const { return method == Method::AdaptiveSplitting; }
    /// Is every one of so many lights a candidate, without a tree?
    bool considers_all(uint32_t lights) const {
        return lights <= reservoirs || expected_candidates() > kMaxExpectedCandidates;
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

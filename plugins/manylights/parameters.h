#pragma once

/**
 * The parameters of the estimator, shared by all integrators: one reader, so that names,
 * ranges and error messages cannot differ.
 */

#include "reservoirs.h"
#include <cmath>
#include <mitsuba/core/properties.h>

namespace manylights {

/// Where candidates come from
enum class Method { ResampledTree, Talk };

/// See the documentation of the plugin manylights_direct
struct SamplingParameters {
    Method method                = Method::ResampledTree;
    SplitFunction split_function = SplitFunction::Near;
    float splitting_rate         = 1.f;
    uint32_t reservoirs = 8, shadow_rays = 4, bsdf_samples = 1;
    /// The same at all vertices of a path but the first
    bool segments           = getenv("SEG") ? atoi(getenv("SEG")) > 0 : true;
    bool all_segments       = getenv("SEG") ? atoi(getenv("SEG")) > 1 : false;
    float deeper_candidates = getenv("DK") ? atof(getenv("DK")) : 8;
    uint32_t deeper_rays    = getenv("DS") ? atoi(getenv("DS")) : 4;

    /// Expected number of candidates K, at least one
    float expected_candidates() const {
        return std::max(1.f, kCandidatesPerRate * splitting_rate);
    }
    /// Upper limit of the number of candidates
    float most_candidates() const {
        return method == Method::Talk ? std::numeric_limits<float>::infinity()
                                      : std::ceil(expected_candidates());
    }
    /// Is K so large that every light is visited?
    bool visits_all() const { return expected_candidates() > kMaxExpectedCandidates; }
};

/// Read and check the parameters; throws with the name, the value and what is allowed
SamplingParameters read_parameters(const mitsuba::Properties &props);

/// The same for paths, where one direction is sampled at each vertex (no `bsdf_samples`)
SamplingParameters read_path_parameters(const mitsuba::Properties &props);

/// "name = value" lines
std::string to_string(const SamplingParameters &params);

} // namespace manylights

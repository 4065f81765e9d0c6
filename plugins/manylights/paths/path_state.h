#pragma once

/// The state of a path, and the limits of all paths.

#include "manylights/direct/group_light.h"
#include "manylights/direct/vertex.h"
#include <mitsuba/render/interaction.h>
#include <mitsuba/render/medium.h>
#include <mitsuba/render/sampler.h>

namespace manylights {

/// Parameters of the paths, as Mitsuba's
struct PathLimits {
    uint32_t max_depth, rr_depth;
    bool hide_emitters;

    /// Does nothing count that is scattered at a vertex after so many?
    template <typename UInt32> auto is_last(const UInt32 &depth) const {
        return depth + 1u >= max_depth;
    }
};

/// `max_depth` of paths that only roulette ends
constexpr uint32_t kUnlimited = (uint32_t) -1;

/// The number that roulette is played with, and what it does not see of the throughput:
/// directions past lamps have a low weight, but are as likely to bring light as others
template <typename Float> struct Roulette {
    Float u = Float(0.f), factor = Float(1.f);
};

/// Of a path's throughput, 0 where it ends: what is black goes on like white if its derivative is
/// wanted
template <typename Float, typename Spectrum>
Float roulette_brightness(const Spectrum &throughput) {
    Float most = dr::max(mitsuba::unpolarized_spectrum(throughput));
    if (has_derivatives(throughput))
        most = dr::select(most == 0.f, 1.f, most);
    return most;
}

/// What a path carries from step to step
template <typename Float, typename Spectrum> struct PathState {
    MI_IMPORT_TYPES(Sampler, Medium, MediumPtr)
    using FloatD = dr::detached_t<Float>;

    Mask active, valid;
    /// Did a last flight end in fog? Alpha does not count what its exact transmittance shows
    Mask ended;
    UInt32 depth;
    Ray3f ray;
    PreliminaryIntersection3f pi;
    MediumPtr medium;
    Spectrum throughput, result;
    /// Of the flights so far, for each channel, over their mean (scene/media.h)
    UnpolarizedSpectrum densities;
    Float eta;
    /// The vertex before, for the density of finding its lights by chance
    Receiver<FloatD> from;
    Float u_tree, pdf;
    /// Did the path leave it by a direction that light sampling cannot find?
    Mask specular;
    Counts<Float> counts;
    GroupSums<Float> groups;
    Sampler *sampler;
    DRJIT_STRUCT(PathState, active, valid, ended, depth, ray, pi, medium, throughput,
                 result, densities, eta, from, u_tree, pdf, specular, counts, groups,
                 sampler)

    PathState(Sampler *sampler, const Ray3f &ray, const Medium *medium, Mask active)
        : active(active), valid(false), ended(false), depth(0), ray(ray), medium(medium),
          throughput(1.f), result(0.f), densities(1.f), eta(1.f),
          from(dr::zeros<Receiver<FloatD>>()), u_tree(0.f), pdf(1.f), specular(true),
          sampler(sampler) {}
};

} // namespace manylights

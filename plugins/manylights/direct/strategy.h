#pragma once

/**
 * How lights are chosen, decided once from the parameters and the number N of lights; m is
 * the number of reservoirs, s <= m that of shadow rays, K the expected number of candidates.
 *
 *     method, number of lights        source of candidates    fate of candidates
 *     any, N <= s                     AllLights               TraceAll
 *     any, N <= m                     AllLights               KeepAll
 *     resampled_tree, K <= s; tree    Systematic              TraceAll
 *     resampled_tree, K <= m          Systematic              KeepAll
 *     resampled_tree, K > m           Systematic              Resample
 *     exhaustive, N > m               AllLights               Resample
 *     talk                            Splitting               Resample
 *     adaptive_splitting              Splitting               TraceAll
 *
 * Sampling and its density ask \ref Strategy::with_source alone where candidates come from,
 * so that they cannot disagree.
 */

#include "manylights/base/slots.h"
#include "manylights/choice/all_lights.h"
#include "manylights/choice/splitting.h"
#include "manylights/choice/systematic.h"
#include "vertex.h"
#include <algorithm>
#include <cmath>
#include <limits>

namespace manylights {

/// Where candidates come from
enum class Source { AllLights, Systematic, Splitting };

/// What becomes of candidates: a shadow ray for each, a slot for each, or resampling
enum class Fate { TraceAll, KeepAll, Resample };

/// K for a splitting rate of 1: at the first vertex, how much less at each that follows, and at
/// least. Rays that lead to the vertices of a path cost as much as shadow rays, and light that has
/// been reflected is dimmer: fewer pay on paths, and fewer from vertex to vertex.
struct Effort {
    float first, less, least;

    /// K at a vertex after `depth` others, at least one
    template <typename Float, typename UInt32>
    Float candidates(const Float &splitting_rate, const UInt32 &depth) const {
        Float k(first);
        if (less > 0.f)
            k = dr::maximum(k - less * Float(depth), least);
        return dr::maximum(k * splitting_rate, 1.f);
    }
};

/// In fog a piece of a path asks twice, for its segment and for its end; in smoke half pays, too
inline Effort effort_of(const SamplingParameters &params, bool in_media) {
    constexpr float most = 16.f;
    // Systematic sampling would lose the fraction of a float
    static_assert(most * kMaxSplittingRate <= 1 << 14);
    if (!params.several_bounces)
        return { most, 0.f, most };
    return in_media ? Effort{ 3.f, 1.f, 1.f } : Effort{ 6.f, 2.f, 2.f };
}

/*
 * The sources: `cursor` starts at the first candidate of a vertex, with its random number of
 * the tree; `inclusion_probability` is that of `light` to be one of them.
 */

template <typename FloatD> struct AllLightsSource {
    using UInt32D = dr::uint32_array_t<FloatD>;
    using MaskD   = dr::mask_t<FloatD>;
    const SamplingParameters &params;

    template <typename Vertex>
    auto cursor(const TreeView<FloatD> &tree, const Vertex &, const FloatD &) const {
        return AllLights<FloatD>(dr::opaque<UInt32D>(tree.light_count));
    }
    FloatD inclusion_probability(const TreeView<FloatD> &, const Receiver<FloatD> &,
                                 const UInt32D &, const FloatD &, const MaskD &) const {
        return AllLights<FloatD>::inclusion_probability();
    }
};

template <typename FloatD> struct SystematicSource {
    using UInt32D = dr::uint32_array_t<FloatD>;
    using MaskD   = dr::mask_t<FloatD>;
    FloatD expected;

    template <typename Vertex>
    auto cursor(const TreeView<FloatD> &, const Vertex &vertex, const FloatD &u) const {
        return SystematicCursor<FloatD>(vertex.top, expected, u);
    }
    FloatD inclusion_probability(const TreeView<FloatD> &tree, const Receiver<FloatD> &at,
                                 const UInt32D &light, const FloatD &,
                                 const MaskD &active) const {
        return SystematicCursor<FloatD>::inclusion_probability(tree, at, light, expected,
                                                               active);
    }
};

template <typename FloatD> struct SplittingSource {
    using UInt32D = dr::uint32_array_t<FloatD>;
    using MaskD   = dr::mask_t<FloatD>;
    const SamplingParameters &params;

    template <typename Vertex>
    auto cursor(const TreeView<FloatD> &tree, const Vertex &vertex,
                const FloatD &u) const {
        return start(tree, vertex.at, u);
    }
    FloatD inclusion_probability(const TreeView<FloatD> &tree, const Receiver<FloatD> &at,
                                 const UInt32D &light, const FloatD &u,
                                 const MaskD &active) const {
        return start(tree, at, u).inclusion_probability(tree, at, light, active);
    }

private:
    SplittingCursor<FloatD> start(const TreeView<FloatD> &tree,
                                  const Receiver<FloatD> &at, const FloatD &u) const {
        return { tree, at, dr::opaque<FloatD>(params.splitting_rate), u,
                 params.method == Method::Talk ? params.split_function
                                               : SplitFunction::Variance };
    }
};

/// See the top of the file
struct Strategy {
    const SamplingParameters &params;
    Effort effort;
    Source source;
    Fate fate;
    /// Does h or H compare lights with each other?
    bool compares;
    /// Places for kept lights, those for lights at infinity, and both
    uint32_t slots, infinite, items;
    /// Probability with which a light at infinity is an item: of many, one is chosen
    float infinite_probability;
    /// Do shadow rays go to some of the kept lights only? If not, lights at infinity all get one
    bool chooses;
    uint32_t rays;
    /// Are the samples behind the targets kept for the rays instead of being computed again?
    /// That pays in scalar variants; in LLVM variants each slot is written with a selection.
    bool keeps_samples;

    /// @param in_media       may light be scattered in media?
    /// @param exact_targets  does a target come from the sample that its ray would get?
    Strategy(const SamplingParameters &params, uint32_t lights, uint32_t infinite_lights,
             bool in_media, bool exact_targets)
        : params(params), effort(effort_of(params, in_media)) {
        bool all      = params.considers_all(lights);
        source        = all                     ? Source::AllLights
                        : params.splits_nodes() ? Source::Splitting
                                                : Source::Systematic;
        float most    = all ? (float) lights : most_candidates();
        bool fits     = most <= (float) params.reservoirs;
        bool few      = infinite_lights <= kMaxInfinite;
        slots         = fits ? std::min((uint32_t) most, lights) : params.reservoirs;
        infinite      = few ? infinite_lights : 1;
        items         = slots + infinite;
        compares      = !(all && fits);
        chooses       = !params.traces_all() && slots > params.shadow_rays;
        fate          = !fits && !params.traces_all() ? Fate::Resample
                        : chooses                     ? Fate::KeepAll
                                                      : Fate::TraceAll;
        rays          = chooses ? params.shadow_rays : items;
        keeps_samples = exact_targets && chooses;
        infinite_probability = few ? 1.f : 1.f / infinite_lights;
    }

    /// Call f with the source of candidates for a vertex after `depth` others
    template <typename FloatD, typename F>
    auto with_source(const dr::uint32_array_t<FloatD> &depth, const F &f) const {
        switch (source) {
            case Source::Systematic:
                return f(SystematicSource<FloatD>{ effort.candidates(
                    dr::opaque<FloatD>(params.splitting_rate), depth) });
            case Source::Splitting:
                return f(SplittingSource<FloatD>{ params });
            case Source::AllLights:
                break;
        }
        return f(AllLightsSource<FloatD>{ params });
    }

private:
    /// Upper limit of their number at any vertex
    float most_candidates() const {
        return params.splits_nodes()
                   ? std::numeric_limits<float>::infinity()
                   : std::ceil(effort.candidates(params.splitting_rate, 0u));
    }
};

} // namespace manylights

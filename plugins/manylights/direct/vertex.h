#pragma once

/**
 * A vertex of a path: where light is scattered, on a surface or in a medium. The direct
 * light is the same computation for both; only what differs is asked of the vertex.
 */

#include "manylights/choice/parameters.h"
#include "manylights/receiver/receiver_reader.h"
#include "manylights/receiver/segment_distances.h"
#include "manylights/scene/media.h"
#include "manylights/tree/tree_view.h"

namespace manylights {

/// Random numbers of one vertex; the first two profit most from stratification
template <typename Float> struct LightSample {
    using Point2f = mitsuba::Point<Float, 2>;
    Float tree, selection;
    Point2f point;
    /// Along a segment
    Float distance = Float(0.f);
};

/// What light sampling did, for those who ask: where nobody does, it drops out of kernels
template <typename Float> struct Counts {
    using FloatD      = dr::detached_t<Float>;
    FloatD candidates = FloatD(0.f), node_visits = FloatD(0.f), expected = FloatD(0.f);
    DRJIT_STRUCT(Counts, candidates, node_visits, expected)

    template <typename UInt32>
    void add(const UInt32 &found, const UInt32 &visits, const dr::mask_t<Float> &active) {
        auto on = plain(active);
        candidates += dr::select(on, FloatD(found), 0.f);
        node_visits += dr::select(on, FloatD(visits), 0.f);
    }
    /// Film channels, see \ref count_channels; null: the caller has none
    void write(Float *aovs, const SamplingParameters &params) const {
        if (!aovs)
            return;
        aovs[0] = Float(candidates);
        aovs[1] = Float(node_visits);
        if (params.method == Method::ResampledTree)
            aovs[2] = Float(expected);
    }
};

/// The medium that surrounds a path, and where it scatters therein
template <typename Float, typename Spectrum> struct InMedium {
    MI_IMPORT_TYPES(MediumPtr)
    MediumPtr medium;
    MediumInteraction3f mei;
    /// Is the vertex in the medium? Otherwise it is the surface at the end of the ray.
    Mask here;
    /// Is it all of a segment that starts at `start`? Its length (0: a point)
    Point3f start;
    Float length;
};

/// The phase function around a point in a medium, null in other lanes
template <typename MediumInteraction3f, typename Mask>
auto phase_of(const MediumInteraction3f &mei, Mask active) {
    auto result                 = mei.medium->phase_function();
    dr::masked(result, !active) = nullptr;
    return result;
}

/// A vertex on a surface, at a point in a medium, or anywhere on a segment in a medium
template <typename Float, typename Spectrum> struct Vertex {
    MI_IMPORT_TYPES(Sampler, BSDFPtr, PhaseFunctionPtr)
    using FloatD    = dr::detached_t<Float>;
    using InMedium  = manylights::InMedium<Float, Spectrum>;
    using Reader    = ReceiverReader<Float, Spectrum>;
    using Distances = SegmentDistances<FloatD>;

    const SurfaceInteraction3f &si;
    const BSDFPtr &bsdf;
    /// Null if the scene has no media
    const InMedium *inside;
    LightSample<Float> u;
    /// How many vertices of its path are before it
    dr::uint32_array_t<FloatD> depth;
    /// As the tree sees it
    Receiver<FloatD> at;
    /// Where descents of the tree begin, if it has one
    TopWeights<FloatD> top;
    /// On a segment: density of free flights over that of the chosen distance, so that light
    /// sampling and phase sampling are compared as densities of distance and direction
    Float flight_ratio = Float(1.f);

    Vertex(const SurfaceInteraction3f &si, const BSDFPtr &bsdf, const InMedium *inside,
           const LightSample<Float> &u, const UInt32 &depth, const ReceiverTraits &traits,
           Mask active)
        : si(si), bsdf(bsdf), inside(inside), u(u), depth(plain(depth)),
          at(dr::zeros<Receiver<FloatD>>()) {
        at.traits()  = traits;
        Mask surface = on_surface(active);
        if (at.extent == Extent::Point && dr::any_or<true>(surface))
            Reader::read(at, si, bsdf, surface);
        if (inside)
            Reader::add_medium(at, *inside, active);
    }

    Mask on_surface(Mask active) const {
        return inside ? Mask(active && !inside->here) : active;
    }

    /// Can sampled lights reach it on a surface? Not on a mirror
    Mask is_lit_surface(Mask active) const {
        Mask surface = on_surface(active);
        return surface && has_flag(bsdf->flags(), mitsuba::BSDFFlags::Smooth);
    }

    /// The same on surfaces and in media
    Mask is_lit(Mask active) const {
        Mask lit = is_lit_surface(active);
        return inside ? Mask(lit || (active && inside->here)) : lit;
    }

    /// Where its shadow rays start
    Interaction3f origin() const {
        Interaction3f it(si);
        if (inside) {
            dr::masked(it.p, inside->here) = inside->mei.p;
            dr::masked(it.n, inside->here) = 0.f;
            it.time                        = inside->mei.time;
            it.wavelengths                 = inside->mei.wavelengths;
        }
        return it;
    }

    /// BSDF times cosine, or phase function, towards `d`, and the density of sampling `d`
    /// (on surfaces only if wanted)
    std::pair<Spectrum, Float> eval_pdf(const Vector3f &d, bool with_pdf,
                                        Mask active) const {
        std::pair<Spectrum, Float> result(0.f, 0.f);
        mitsuba::BSDFContext ctx;
        Mask surface = on_surface(active);
        if (at.extent == Extent::Point && dr::any_or<true>(surface)) {
            Vector3f wo = si.to_local(d);
            if (with_pdf)
                result = bsdf->eval_pdf(ctx, si, wo, surface);
            else
                result.first = bsdf->eval(ctx, si, wo, surface);
            result.first = si.to_world_mueller(result.first, -wo, si.wi);
        }
        if (!inside)
            return result;
        Mask scattered = active && inside->here;
        if (dr::any_or<true>(scattered)) {
            mitsuba::PhaseFunctionContext<Float, Spectrum> ctx;
            auto [value, pdf] = phase_of(inside->mei, scattered)
                                    ->eval_pdf(ctx, inside->mei, d, scattered);
            dr::masked(result.first, scattered)  = value;
            dr::masked(result.second, scattered) = pdf * flight_ratio;
        }
        return result;
    }
};

} // namespace manylights

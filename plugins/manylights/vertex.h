#pragma once

/**
 * A vertex of a path: where light is scattered, on a surface or in a medium. The direct
 * light is the same computation for both; only what differs is asked of the vertex.
 */

#include "media.h"
#include "receiver.h"

namespace manylights {

/// Random numbers of one vertex; the first two profit most from stratification
template <typename Float> struct LightSample {
    using Point2f = mitsuba::Point<Float, 2>;
    Float tree, selection;
    Point2f point;
};

/// The medium that surrounds a path, and where it scatters therein
template <typename Float, typename Spectrum> struct InMedium {
    MI_IMPORT_TYPES(MediumPtr)
    MediumPtr medium;
    MediumInteraction3f mei;
    /// Is the vertex in the medium? Otherwise it is the surface at the end of the ray.
    Mask scattered;
};

template <typename Float, typename Spectrum> struct Vertex {
    MI_IMPORT_TYPES(Sampler, BSDFPtr, PhaseFunctionPtr)
    using FloatD   = dr::detached_t<Float>;
    using InMedium = manylights::InMedium<Float, Spectrum>;

    /// The vertex on a surface ...
    const SurfaceInteraction3f &si;
    const BSDFPtr &bsdf;
    /// ... or in a medium; null if the scene has none
    const InMedium *inside;
    LightSample<Float> u;
    /// As the tree sees it
    Receiver<FloatD> at;

    Vertex(const SurfaceInteraction3f &si, const BSDFPtr &bsdf, const InMedium *inside,
           const LightSample<Float> &u, bool glossy, Mask active)
        : si(si), bsdf(bsdf), inside(inside), u(u) {
        Mask surface = active;
        if (inside)
            surface &= !inside->scattered;
        using Reader = ReceiverReader<Float, Spectrum>;
        at           = dr::any_or<true>(surface)
                           ? Reader::read(si, bsdf, glossy, surface)
                           : dr::zeros<Receiver<FloatD>>();
        if (inside)
            Reader::add_medium(at, inside->mei, inside->medium, inside->scattered,
                               active);
        at.glossy = glossy;
        at.media  = inside != nullptr;
    }

    /// Where its shadow rays start
    Interaction3f origin() const {
        Interaction3f it(si);
        if (inside) {
            dr::masked(it.p, inside->scattered) = inside->mei.p;
            dr::masked(it.n, inside->scattered) = 0.f;
            it.time                             = inside->mei.time;
            it.wavelengths                      = inside->mei.wavelengths;
        }
        return it;
    }

    /// BSDF times cosine, or phase function, towards `d`, and the density of sampling `d`
    /// (surfaces: if wanted)
    std::pair<Spectrum, Float> eval_pdf(const Vector3f &d, bool with_pdf,
                                        Mask active) const {
        std::pair<Spectrum, Float> result(0.f, 0.f);
        mitsuba::BSDFContext ctx;
        Mask surface = on_surface(active);
        if (dr::any_or<true>(surface)) {
            Vector3f wo = si.to_local(d);
            if (with_pdf)
                result = bsdf->eval_pdf(ctx, si, wo, surface);
            else
                result.first = bsdf->eval(ctx, si, wo, surface);
            result.first = si.to_world_mueller(result.first, -wo, si.wi);
        }
        if (inside) {
            Mask scattered = active && inside->scattered;
            if (dr::any_or<true>(scattered)) {
                auto [value, pdf] = phase(scattered)->eval_pdf(
                    mitsuba::PhaseFunctionContext<Float, Spectrum>(), inside->mei, d,
                    scattered);
                dr::masked(result.first, scattered)  = value;
                dr::masked(result.second, scattered) = pdf;
            }
        }
        return result;
    }

    Mask on_surface(Mask active) const {
        return inside ? Mask(active && !inside->scattered) : active;
    }

    PhaseFunctionPtr phase(Mask active) const {
        PhaseFunctionPtr result = inside->mei.medium->phase_function();
        dr::masked(result, !active) = nullptr;
        return result;
    }
};

} // namespace manylights

#pragma once

/// The directions in which paths go on from a surface or a point in a medium.

#include "piece.h"
#include <mitsuba/render/bsdf.h>
#include <mitsuba/render/phase.h>

namespace manylights {

/// Where a path goes on
template <typename Float, typename Spectrum> struct Direction {
    MI_IMPORT_TYPES()

    Ray3f ray;
    Spectrum weight;
    Float pdf, eta;
    Mask specular, null;
};

template <typename Float, typename Spectrum> class Scattering {
public:
    MI_IMPORT_TYPES()
    using State     = PathState<Float, Spectrum>;
    using Piece     = manylights::Piece<Float, Spectrum>;
    using Direction = manylights::Direction<Float, Spectrum>;
    using Vertex    = manylights::Vertex<Float, Spectrum>;

    /// @param segments  is single scattering estimated along whole segments?
    Scattering(const PathLimits &limits, bool segments)
        : m_limits(limits), m_segments(segments) {}

    /// A direction from the BSDF or the phase function, whichever a lane has come to
    MI_NOINLINE Direction sample_either(const State &s, const Vertex &vertex,
                                        const Piece &piece, const Float &u1,
                                        const Point2f &u2) const {
        Direction next = dr::zeros<Direction>();
        Mask surface   = s.active && !piece.scattered;
        if (dr::any_or<true>(surface))
            next = sample_bsdf(vertex, u1, u2, surface);
        if (m_limits.hide_emitters) {
            next.null |= piece.hidden;
            dr::masked(next.ray, piece.hidden)    = vertex.si.spawn_ray(s.ray.d);
            dr::masked(next.weight, piece.hidden) = Spectrum(1.f);
            dr::masked(next.eta, piece.hidden)    = 1.f;
        }
        Mask scattered = s.active && piece.scattered;
        if (dr::any_or<true>(scattered))
            next = merge(next, sample_phase(s, piece, u1, u2, scattered), scattered);
        return next;
    }

    Direction sample_bsdf(const Vertex &vertex, const Float &u1, const Point2f &u2,
                          Mask active) const {
        const SurfaceInteraction3f &si = vertex.si;
        mitsuba::BSDFContext ctx;
        auto [bs, weight] = vertex.bsdf->sample(ctx, si, u1, u2, active);
        weight            = si.to_world_mueller(weight, -bs.wo, si.wi);
        Ray3f ray         = si.spawn_ray(si.to_world(bs.wo));
        if (dr::grad_enabled(ray)) {
            // Directions are not differentiated: evaluate again what depends on them
            ray                           = dr::detach<true>(ray);
            Vector3f wo                   = si.to_local(ray.d);
            auto [value, pdf]             = vertex.bsdf->eval_pdf(ctx, si, wo, active);
            value                         = si.to_world_mueller(value, -wo, si.wi);
            dr::masked(weight, pdf > 0.f) = value / dr::detach(pdf);
        }
        return { ray,
                 weight & active,
                 bs.pdf,
                 bs.eta,
                 has_flag(bs.sampled_type, mitsuba::BSDFFlags::Delta),
                 has_flag(bs.sampled_type, mitsuba::BSDFFlags::Null) };
    }

private:
    Direction sample_phase(const State &s, const Piece &piece, const Float &u1,
                           const Point2f &u2, Mask active) const {
        const MediumInteraction3f &mei = piece.inside.mei;
        mitsuba::PhaseFunctionContext<Float, Spectrum> ctx(s.sampler);
        auto phase             = phase_of(mei, active);
        auto [wo, weight, pdf] = phase->sample(ctx, mei, u1, u2, active);
        Ray3f ray              = mei.spawn_ray(wo);
        if (dr::grad_enabled(ray)) {
            ray                = dr::detach<true>(ray);
            auto [value, pdf2] = phase->eval_pdf(ctx, mei, ray.d, active);
            weight             = value / dr::detach(pdf2);
        }
        if (m_segments) { // a density of distance and direction, as that of light sampling
            const UnpolarizedSpectrum &sigma = mei.combined_extinction;
            Float density                    = dr::mean(sigma * dr::exp(-mei.t * sigma));
            dr::masked(pdf, piece.segment)   = pdf * density;
        }
        return { ray,        weight & (active && pdf > 0.f),      pdf,
                 Float(1.f), !mei.medium->use_emitter_sampling(), Mask(false) };
    }

    static Direction merge(const Direction &a, const Direction &b, Mask use_b) {
        return { dr::select(use_b, b.ray, a.ray),
                 dr::select(use_b, b.weight, a.weight),
                 dr::select(use_b, b.pdf, a.pdf),
                 dr::select(use_b, b.eta, a.eta),
                 dr::select(use_b, b.specular, a.specular),
                 dr::select(use_b, b.null, a.null) };
    }

    const PathLimits &m_limits;
    bool m_segments;
};

} // namespace manylights

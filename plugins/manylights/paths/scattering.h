#pragma once

/// The directions in which paths go on from a surface or a point in a medium.

#include "lamp_directions.h"
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
    /// By how much likelier it was than without lamps, which the weight is lower for
    Float past_lamps = Float(1.f);
};

template <typename Float, typename Spectrum> class Scattering {
public:
    MI_IMPORT_TYPES()
    using State     = PathState<Float, Spectrum>;
    using Piece     = manylights::Piece<Float, Spectrum>;
    using Direction = manylights::Direction<Float, Spectrum>;
    using Vertex    = manylights::Vertex<Float, Spectrum>;
    using FloatD    = dr::detached_t<Float>;

    /// @param segments  is single scattering estimated along whole segments?
    Scattering(const PathLimits &limits, bool segments, const TreeView<FloatD> &tree)
        : m_limits(limits), m_tree(tree), m_segments(segments),
          m_past_lamps(segments && tree.light_count > 0 && limits.max_depth > 2) {}

    /// A direction from the BSDF or the phase function, whichever a lane has come to
    MI_NOINLINE Direction sample_either(const State &s, const Vertex &vertex,
                                        const Piece &piece, const Float &u1,
                                        const Point2f &u2) const {
        Direction next  = dr::zeros<Direction>();
        next.past_lamps = Float(1.f);
        Mask surface    = s.active && !piece.scattered;
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
            next = merge(next,
                         m_past_lamps ? sample_past_lamps(s, piece, u1, u2, scattered)
                                      : sample_phase(s, piece, u1, u2, scattered),
                         scattered);
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
        return to_direction(piece, ray, weight & (active && pdf > 0.f), pdf);
    }

    /**
     * A direction of the mixture (1 - b) phase + b lamps. The density that is compared with that
     * of light sampling is that of the phase function alone, on both sides: any other would cost
     * a look at all clusters for each light.
     */
    MI_NOINLINE Direction sample_past_lamps(const State &s, const Piece &piece,
                                            const Float &u1, const Point2f &u2,
                                            Mask active) const {
        const MediumInteraction3f &mei = piece.inside.mei;
        mitsuba::PhaseFunctionContext<Float, Spectrum> ctx(s.sampler);
        auto phase = phase_of(mei, active);
        LampDirections<FloatD> lamps(m_tree, piece.along, plain(mei.p));
        Float share = share_of_lamps(s, piece, phase, active) * Float(lamps.visible());
        Mask past   = active && u1 < share;
        Float v = dr::select(past, u1, u1 - share) / dr::select(past, share, 1.f - share);
        v       = dr::minimum(v, kBelowOne);
        auto wo = std::get<0>(phase->sample(ctx, mei, v, u2, active && !past));
        if (dr::any_or<true>(past))
            dr::masked(wo, past) =
                Vector3f(lamps.sample(plain(v), { plain(u2.x()), plain(u2.y()) }));
        Ray3f ray         = dr::detach<true>(mei.spawn_ray(wo));
        auto [value, pdf] = phase->eval_pdf(ctx, mei, ray.d, active);
        Float likelier    = 1.f - share + share * Float(lamps.pdf(plain(ray.d))) / pdf;
        likelier = dr::detach(dr::select(share > 0.f && pdf > 0.f, likelier, 1.f));
        Direction result = to_direction(
            piece, ray, (value / (dr::detach(pdf) * likelier)) & (active && pdf > 0.f),
            pdf);
        result.past_lamps = likelier;
        return result;
    }

    /**
     * How many directions follow lamps that are not hidden: none if the light of the next segment
     * does not count, half of them at most, and few where droplets scatter forwards, since most
     * lamps are then off the phase function's lobe.
     */
    template <typename Phase>
    Float share_of_lamps(const State &s, const Piece &piece, const Phase &phase,
                         Mask active) const {
        const MediumInteraction3f &mei = piece.inside.mei;
        mitsuba::PhaseFunctionContext<Float, Spectrum> ctx(s.sampler);
        Mask counts = active && piece.segment && !m_limits.is_last(s.depth + 1u);
        Float peak  = std::get<1>(phase->eval_pdf(ctx, mei, -mei.wi, counts));
        Float wide  = dr::rsqrt(dr::maximum(4.f * dr::Pi<Float> * peak, 1.f));
        return dr::detach(dr::select(counts, .5f * wide, 0.f));
    }

    Direction to_direction(const Piece &piece, const Ray3f &ray, const Spectrum &weight,
                           Float pdf) const {
        const MediumInteraction3f &mei = piece.inside.mei;
        if (m_segments) { // a density of distance and direction, as that of light sampling
            const UnpolarizedSpectrum &sigma = mei.combined_extinction;
            Float density                    = dr::mean(sigma * dr::exp(-mei.t * sigma));
            dr::masked(pdf, piece.segment)   = pdf * density;
        }
        return { ray,        weight, pdf, Float(1.f), !mei.medium->use_emitter_sampling(),
                 Mask(false) };
    }

    static Direction merge(const Direction &a, const Direction &b, Mask use_b) {
        return { dr::select(use_b, b.ray, a.ray),
                 dr::select(use_b, b.weight, a.weight),
                 dr::select(use_b, b.pdf, a.pdf),
                 dr::select(use_b, b.eta, a.eta),
                 dr::select(use_b, b.specular, a.specular),
                 dr::select(use_b, b.null, a.null),
                 dr::select(use_b, b.past_lamps, a.past_lamps) };
    }

    const PathLimits &m_limits;
    const TreeView<FloatD> &m_tree;
    /// Are there segments, and do directions from points on them look for lamps?
    bool m_segments, m_past_lamps;
};

} // namespace manylights

#pragma once

/**
 * The shading point as the tree sees it (\ref Receiver), from Mitsuba's interaction and BSDF,
 * and the scalar by which contributions are compared.
 */

#include "lobes.h"
#include <mitsuba/render/bsdf.h>
#include <mitsuba/render/interaction.h>
#include <mitsuba/render/medium.h>

namespace manylights {

template <typename Float, typename Spectrum> class ReceiverReader {
public:
    MI_IMPORT_TYPES(BSDFPtr, MediumPtr)
    using FloatD = dr::detached_t<Float>;
    using MaskD  = dr::mask_t<FloatD>;

    /// Positive wherever the value is not zero; invalid values are never chosen. In units of
    /// the scene's brightest light if `scale` is that of its tree.
    static FloatD target(const Spectrum &value, const FloatD &scale = 1.f) {
        auto v = plain(mitsuba::unpolarized_spectrum(value)) * scale;
        FloatD g;
        if constexpr (mitsuba::is_rgb_v<Spectrum>) {
            // Why: see emission_reader.h. No square leaves the range of floats
            FloatD most = dr::max(dr::abs(v));
            g           = most * root_mean_square(v / most);
        } else {
            g = dr::mean(v);
        }
        // Bounded, so that sums of targets and weights stay finite
        return dr::select(g > 0.f && dr::isfinite(g), dr::minimum(g, 1e25f), 0.f);
    }

    /// Lobes are measured only where there may be one: each costs two evaluations of the BSDF
    static void read(Receiver<FloatD> &at, const SurfaceInteraction3f &si,
                     const BSDFPtr &bsdf, Mask active) {
        auto flags     = bsdf->flags(active);
        Mask transmits = has_flag(flags, mitsuba::BSDFFlags::Transmission);
        Vector3f n     = dr::mulsign(Vector3f(si.sh_frame.n), Frame3f::cos_theta(si.wi));
        at.p           = plain(si.p);
        at.n           = plain(n);
        at.wi          = plain(si.to_world(si.wi));
        at.transmits   = plain(transmits);
        if (at.lobes != Lobes::None)
            measure_lobe(si, bsdf, at,
                         active && has_flag(flags, mitsuba::BSDFFlags::Glossy));
        if (at.lobes == Lobes::Transmitted)
            measure_transmission(
                si, bsdf, at,
                active && has_flag(flags, mitsuba::BSDFFlags::GlossyTransmission));
    }

    /// The medium around a surface, or a point or a segment in the medium: no cosine, no lobe
    template <typename InMedium>
    MI_NOINLINE static void add_medium(Receiver<FloatD> &at, const InMedium &inside,
                                       Mask active) {
        active &= inside.medium != nullptr;
        if (dr::any_or<true>(active))
            active &= inside.medium->is_homogeneous();
        MaskD here = plain(inside.here);
        read_extinction(at, inside.mei.combined_extinction, plain(active));
        at.in_medium           = here;
        at.length              = plain(inside.length);
        at.p                   = dr::select(at.length > 0.f, plain(inside.start),
                                            dr::select(here, plain(inside.mei.p), at.p));
        at.wi                  = dr::select(here, plain(inside.mei.wi), at.wi);
        dr::masked(at.n, here) = 0.f;
        dr::masked(at.diffuse, here)     = 1.f;
        dr::masked(at.specular, here)    = 0.f;
        dr::masked(at.transmitted, here) = 0.f;
        dr::masked(at.alpha2, here)      = 1.f;
    }

private:
    /// The smallest extinction sees farthest; where it is 0, nothing is scattered
    static void read_extinction(Receiver<FloatD> &at, const UnpolarizedSpectrum &sigma,
                                const MaskD &active) {
        if (at.channels == 0) {
            at.extinction = dr::select(active, plain(sigma.entry(0)), 0.f);
            return;
        }
        FloatD least = dr::min(
            plain(dr::select(sigma > 0.f, sigma, dr::Infinity<UnpolarizedSpectrum>)));
        at.extinction = dr::select(active && dr::isfinite(least), least, 0.f);
        for (uint32_t i = 0; i < at.channels; ++i)
            at.extinctions.entry(i) = dr::maximum(plain(sigma.entry(i)), at.extinction);
    }

    /// Targets and a density
    using Measured = dr::Array<FloatD, 3>;

    /// f(BSDF, interaction, active), once for each BSDF of active lanes
    template <typename F>
    static Measured call_bsdf(const F &f, const BSDFPtr &bsdf,
                              const SurfaceInteraction3f &si, Mask active) {
        if constexpr (dr::is_jit_v<Float>)
            return dr::dispatch(bsdf, f, si, active);
        else
            return f(bsdf, si, active);
    }

    /**
     * The glossy lobe, for any BSDF that may have one: its value and density in the mirror direction, and its
     * value well off the lobe. A GGX lobe has the density 1 / (4 pi alpha^2 cos) at its peak.
     * Only h and H see this, so it does not have to be right.
     */
    MI_NOINLINE static void measure_lobe(const SurfaceInteraction3f &si,
                                         const BSDFPtr &bsdf, Receiver<FloatD> &at,
                                         Mask active) {
        at.diffuse = kTypicalBsdf;
        at.alpha2  = 1.f;
        if (dr::none_or<false>(active))
            return;
        dr::suspend_grad<Float> detached;
        // One call, in which all that both evaluations have in common is computed once
        auto measured = call_bsdf(
            [](const auto *b, const SurfaceInteraction3f &it, Mask on) {
                mitsuba::BSDFContext ctx;
                Vector3f mirror(-it.wi.x(), -it.wi.y(), it.wi.z());
                // At 60 degrees from the normal, at a right angle to the plane of incidence
                Float inv = .866f * dr::rsqrt(dr::square(it.wi.x()) +
                                              dr::square(it.wi.y()) + 1e-12f);
                Vector3f aside(-it.wi.y() * inv, it.wi.x() * inv,
                               dr::mulsign(Float(.5f), Frame3f::cos_theta(it.wi)));
                auto [peak, density] = b->eval_pdf(ctx, it, mirror, on);
                Spectrum base        = b->eval(ctx, it, aside, on);
                return Measured(target(peak), plain(density), target(base));
            },
            bsdf, si, active);
        FloatD on = measured[0], density = measured[1], off = measured[2] * 2.f;
        FloatD cosine = dr::maximum(dr::abs(plain(Frame3f::cos_theta(si.wi))), 1e-3f);
        FloatD alpha2 = dr::rcp(4.f * dr::Pi<FloatD> * cosine *
                                dr::maximum(density - cosine * dr::InvPi<FloatD>, .05f));
        MaskD glossy  = plain(active);
        at.alpha2     = dr::select(glossy, dr::clip(alpha2, 1e-5f, 1.f), 1.f);
        FloatD specular =
            dr::maximum(on - off * cosine, 0.f) * at.alpha2 / masking(cosine, at.alpha2);
        at.specular = dr::select(glossy, specular, 0.f);
        // The share that the lobe never takes away
        dr::masked(at.diffuse, glossy) = off + kLobeFloor * on / cosine + 1e-6f;
    }

    /**
     * The lobe of transmission: the BSDF finds its middle, where its density is about
     * 1 / (pi beta^2).
     */
    MI_NOINLINE static void measure_transmission(const SurfaceInteraction3f &si,
                                                 const BSDFPtr &bsdf,
                                                 Receiver<FloatD> &at, Mask active) {
        if (dr::none_or<false>(active))
            return;
        dr::suspend_grad<Float> detached;
        mitsuba::BSDFContext through, ctx;
        through.type_mask = +mitsuba::BSDFFlags::GlossyTransmission;
        auto bs = bsdf->sample(through, si, Float(.5f), Point2f(.5f), active).first;
        active &= bs.pdf > 0.f &&
                  has_flag(bs.sampled_type, mitsuba::BSDFFlags::GlossyTransmission);
        auto [peak, density] = bsdf->eval_pdf(ctx, si, bs.wo, active);
        FloatD on            = dr::select(plain(active), target(peak), 0.f);
        FloatD beta2         = dr::rcp(dr::Pi<FloatD> * plain(density));
        at.beta2       = dr::select(plain(active), dr::clip(beta2, 1e-5f, 4.f), 1.f);
        at.through     = dr::select(plain(active), plain(si.to_world(bs.wo)), 0.f);
        at.transmitted = on * at.beta2;
        FloatD cosine  = dr::maximum(dr::abs(plain(Frame3f::cos_theta(bs.wo))), 1e-3f);
        at.diffuse += kThroughFloor * at.transmitted / cosine;
    }
};

} // namespace manylights

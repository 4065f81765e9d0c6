#pragma once

/**
 * Collisions along a ray in a medium: tentative ones against the majorant, or real ones where the
 * extinction is the same everywhere.
 */

#include "media_kinds.h"
#include <mitsuba/render/interaction.h>
#include <mitsuba/render/medium.h>

namespace manylights {

/// A tentative collision, or a free flight to the end of the distance
template <typename Float, typename Spectrum> struct Collision {
    MI_IMPORT_TYPES()

    MediumInteraction3f mei;
    Mask hit;
    /// Transmittance over the density of the distance
    UnpolarizedSpectrum weight;
    UnpolarizedSpectrum null_fraction;
    UnpolarizedSpectrum densities;
};

/// Samples them
template <typename Float, typename Spectrum> class Collisions {
public:
    MI_IMPORT_TYPES(MediumPtr)
    using Collision = manylights::Collision<Float, Spectrum>;

    explicit Collisions(const MediaKinds &kinds) : m_kinds(kinds) {}

    /**
     * One step of tracking. Where the extinction varies between wavelengths or channels, a
     * random one is followed, its majorant and its chance of a null collision. The density of
     * a path is the mean of those that each of them would have given *all* of it (spectral
     * MIS), so that no weight exceeds their number, however many collisions there are.
     *
     * @param densities  of the path so far, for each channel, over their mean: the chances of
     *                   channels to be followed. They are not differentiated, nor is the
     *                   distance; what is evaluated there is.
     */
    Collision next(const MediumPtr &medium, Ray3f ray, const Float &distance,
                   const UnpolarizedSpectrum &densities, Float u, Mask active) const {
        UInt32 channel(0);
        if (m_kinds.chromatic_majorants)
            std::tie(channel, u) = choose_channel(densities, u);
        ray.maxt = distance;
        Collision c{ medium->sample_interaction(ray, u, channel, active), false, 0.f, 0.f,
                     densities };
        Float end = distance;
        if (m_kinds.heterogeneous) {
            // The medium may end before the surface does, or be missed
            auto [met, near, far] = medium->intersect_aabb(ray);
            met &= dr::isfinite(near) || dr::isfinite(far);
            end = dr::select(met, dr::minimum(distance, far), c.mei.mint);
        }
        if constexpr (mitsuba::is_spectral_v<Spectrum>)
            if (m_kinds.chromatic_majorants)
                follow_channel(c.mei, medium, ray, end, u, channel, active);
        c.mei.t = dr::detach(c.mei.t);
        c.mei.p = dr::detach(c.mei.p);
        c.hit   = active && c.mei.is_valid() && c.mei.t <= end;

        UnpolarizedSpectrum majorant = c.mei.combined_extinction;
        // Finite, so that no extinction over no end leaves 1
        Float length =
            dr::clip(dr::minimum(c.mei.t, end) - c.mei.mint, 0.f, dr::Largest<Float>);
        UnpolarizedSpectrum tr = dr::exp(-length * majorant);
        c.densities   = dr::detach(densities * dr::select(c.hit, tr * majorant, tr));
        Float density = dr::mean(c.densities);
        Mask possible = density > 0.f;
        c.weight      = dr::select(possible, tr / density, 0.f);
        c.densities   = dr::select(possible, c.densities / density, 1.f);
        // Extinctions may exceed a grid's majorant by rounding
        c.null_fraction = dr::detach(dr::clip(
            dr::select(majorant > 0.f, c.mei.sigma_n / majorant, 0.f), 0.f, 1.f));
        return c;
    }

private:
    /// A channel, chosen by its density, and the number u used again
    static std::pair<UInt32, Float> choose_channel(const UnpolarizedSpectrum &densities,
                                                   const Float &u) {
        Float target = u * dr::sum(densities), below(0.f), begin(0.f), share(1.f);
        UInt32 channel(0);
        for (uint32_t i = 0; i < dr::size_v<UnpolarizedSpectrum>; ++i) {
            Float density                = densities.entry(i);
            Mask reached                 = target >= below && density > 0.f;
            dr::masked(channel, reached) = i;
            dr::masked(begin, reached)   = below;
            dr::masked(share, reached)   = density;
            below += density;
        }
        return { channel,
                 dr::clip((target - begin) / share, 0.f, dr::OneMinusEpsilon<Float>) };
    }

    /// A collision at the distance that a wavelength chooses: Mitsuba takes the first one
    void follow_channel(MediumInteraction3f &mei, const MediumPtr &medium,
                        const Ray3f &ray, const Float &end, const Float &u,
                        const UInt32 &channel, Mask active) const {
        Float sigma = mei.combined_extinction.entry(0);
        for (uint32_t i = 1; i < dr::size_v<UnpolarizedSpectrum>; ++i)
            sigma = dr::select(channel == i, mei.combined_extinction.entry(i), sigma);
        Float t = mei.mint - dr::log(1.f - u) / sigma;
        active &= t <= end;
        mei.t = dr::select(active, t, dr::Infinity<Float>);
        mei.p = ray(t);
        std::tie(mei.sigma_s, mei.sigma_n, mei.sigma_t) =
            medium->get_scattering_coefficients(mei, active);
    }

    MediaKinds m_kinds;
};

} // namespace manylights

#pragma once

/// Colours of a film, and its layers with the light of groups.

#include "manylights/direct/group_light.h"
#include <mitsuba/core/spectrum.h>

namespace manylights {

/// What Mitsuba's films take a spectrum for
template <typename Float, typename Spectrum, typename Wavelength>
mitsuba::Color<Float, 3>
film_color(const mitsuba::unpolarized_spectrum_t<Spectrum> &spectrum,
           const Wavelength &wavelengths, const dr::mask_t<Float> &active) {
    (void) wavelengths, (void) active;
    if constexpr (mitsuba::is_spectral_v<Spectrum>)
        return mitsuba::spectrum_to_srgb(spectrum, wavelengths, active);
    else if constexpr (mitsuba::is_monochromatic_v<Spectrum>)
        return spectrum.x();
    else
        return spectrum;
}

/**
 * Write the layers of groups, three channels each.
 *
 * @param sums    without the weight of their ray
 * @param weight  of the ray; null: that of a sensor without a response of its own
 * @param aovs    where the channels are; null: the caller has none
 */
template <typename Float, typename Spectrum, typename Wavelength>
void write_layers(const GroupSums<Float> &sums, const Spectrum *weight,
                  const Wavelength &wavelengths, Float *aovs,
                  const dr::mask_t<Float> &active) {
    using Unpolarized       = mitsuba::unpolarized_spectrum_t<Spectrum>;
    constexpr size_t kCount = dr::size_v<Unpolarized>;
    if (!aovs)
        return;
    Unpolarized factor(1.f);
    if (weight)
        factor = mitsuba::unpolarized_spectrum(*weight);
    else if constexpr (mitsuba::is_spectral_v<Spectrum>)
        factor = dr::rcp(mitsuba::pdf_rgb_spectrum(wavelengths));
    for (size_t group = 0; group * kCount < sums.size(); ++group) {
        Unpolarized value;
        for (size_t i = 0; i < kCount; ++i)
            value.entry(i) = sums[group * kCount + i] * factor.entry(i);
        auto color = film_color<Float, Spectrum>(value, wavelengths, active);
        for (size_t i = 0; i < 3; ++i)
            aovs[3 * group + i] = color.entry(i);
    }
}

} // namespace manylights

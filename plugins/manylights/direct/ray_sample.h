#pragma once

/// A sample of a light before its shadow ray is traced.

#include <mitsuba/core/spectrum.h>
#include <mitsuba/core/vector.h>

namespace manylights {

namespace dr = drjit;

/// A light sample without visibility: F / p, and where the shadow ray leads
template <typename Float, typename Spectrum,
          bool Polarized = mitsuba::is_polarized_v<Spectrum>>
struct RaySample {
    using Point3f = mitsuba::Point<Float, 3>;
    using Mask    = dr::mask_t<Float>;
    Spectrum value;
    Point3f p;
    /// Where the ray starts, if that is a choice of the sample (segments)
    Point3f from;
    /// May the ray end close to it? (shadow_ray.h)
    Mask close;
    DRJIT_STRUCT(RaySample, value, p, from, close)

    static RaySample make(const Spectrum &f, const Spectrum &emission, const Point3f &p,
                          const Point3f &from, const Mask &close) {
        return { f * emission, p, from, close };
    }
    Spectrum unoccluded() const { return value; }
    Spectrum through(const Spectrum &transmittance) const {
        return value * transmittance;
    }
};

/// With polarization what is on the way acts on the emission E first: f T E
template <typename Float, typename Spectrum> struct RaySample<Float, Spectrum, true> {
    using Point3f = mitsuba::Point<Float, 3>;
    using Mask    = dr::mask_t<Float>;
    /// f / p
    Spectrum value;
    Spectrum emission;
    Point3f p, from;
    Mask close;
    DRJIT_STRUCT(RaySample, value, emission, p, from, close)

    static RaySample make(const Spectrum &f, const Spectrum &emission, const Point3f &p,
                          const Point3f &from, const Mask &close) {
        return { f, emission, p, from, close };
    }
    Spectrum unoccluded() const { return value * emission; }
    Spectrum through(const Spectrum &transmittance) const {
        return value * transmittance * emission;
    }
};

} // namespace manylights

#pragma once

/**
 * All kinds of light, and what is asked of a light whatever its kind.
 *
 * A kind is a file beside this one: how it is read from the emitter, its power, how it appears
 * to a shading point, a point on it, the normal there and the density. A new kind has a name in
 * \ref LightKind and a case in \ref with_kind, nothing else.
 */

#include "cylinder.h"
#include "disk.h"
#include "other.h"
#include "point.h"
#include "sphere.h"
#include "spot.h"
#include "triangle.h"

namespace manylights {

/// f of an instance of the kind
template <typename Light, typename F> auto call(const F &f) {
    static_assert((uint32_t) Light::kind < kMostKinds, "the tag has too few bits");
    return f(Light());
}

/// Call f with an instance of the kind. There is no `default`: the compiler names a kind that is
/// forgotten here, and the function that a kind has forgotten
template <typename F> auto with_kind(LightKind kind, const F &f) {
    switch (kind) {
        case LightKind::Point:
            return call<PointLight>(f);
        case LightKind::Spot:
            return call<SpotLight>(f);
        case LightKind::Triangle:
            return call<TriangleLight>(f);
        case LightKind::Sphere:
            return call<SphereLight>(f);
        case LightKind::Disk:
            return call<DiskLight>(f);
        case LightKind::Cylinder:
            return call<CylinderLight>(f);
        case LightKind::Other:
            break;
    }
    return call<OtherLight>(f);
}

/// A bound of the distance of two of its points; 0 if the table knows no surface
inline float light_diameter(const LightRow &row) {
    return with_kind(kind_of(row), [&](auto light) { return light.diameter(row); });
}

/// Emitted power
inline double light_power(const LightRow &row) {
    return with_kind(kind_of(row), [&](auto light) { return light.power(row); });
}

/**
 * Evaluate f(light) for the kinds that occur, instances as of \ref with_kind, and merge the
 * results by the kind of the row. With one kind in the scene nothing is selected.
 */
template <typename Value, typename Float, typename F>
Value by_kind(const Row<Float> &row, KindSet kinds, const F &f) {
    Value result = dr::zeros<Value>();
    for (uint32_t i = 0; i < kMostKinds; ++i) {
        LightKind kind = (LightKind) i;
        if (!kinds.has(kind))
            continue;
        if (kinds.only(kind))
            return with_kind(kind, f);
        if constexpr (dr::is_jit_v<Float>)
            result = dr::select(row.is(kind), with_kind(kind, f), result);
        else if (row.is(kind))
            return with_kind(kind, f);
    }
    return result;
}

/// Is it a point, which no ray hits?
template <typename Float>
dr::mask_t<Float> is_delta(const Row<Float> &row, KindSet kinds) {
    dr::mask_t<Float> result(false);
    for (uint32_t i = 0; i < kMostKinds; ++i) {
        LightKind kind = (LightKind) i;
        if (kinds.has(kind) && with_kind(kind, [](auto light) { return light.is_delta; }))
            result |= row.is(kind);
    }
    return result;
}

/// Does the outside of a light that shines inwards lie between its point p and x? Flat ones hide
/// nothing of themselves.
template <typename Float>
dr::mask_t<Float> hides_itself(const Row<Float> &row, KindSet kinds,
                               const mitsuba::Point<Float, 3> &p,
                               const mitsuba::Point<Float, 3> &x) {
    dr::mask_t<Float> result(false);
    if (kinds.has(LightKind::Sphere))
        result |= row.is(LightKind::Sphere) && SphereLight::hides(row, x);
    if (kinds.has(LightKind::Cylinder))
        result |= row.is(LightKind::Cylinder) && CylinderLight::hides(row, p, x);
    return result;
}

/// Are there lights that shine to one side only, or in a cone?
inline bool have_beams(KindSet kinds) {
    for (uint32_t i = 0; i < kMostKinds; ++i) {
        LightKind kind = (LightKind) i;
        if (kinds.has(kind) && with_kind(kind, [](auto light) { return light.has_beam; }))
            return true;
    }
    return false;
}

/// Where a light shines
template <typename Float> Beam<Float> beam(const Row<Float> &row, KindSet kinds) {
    return by_kind<Beam<Float>>(row, kinds, [&](auto light) { return light.beam(row); });
}

/// How a light appears from x; no less than a share of `least` of its largest intensity where
/// that depends on the direction, if other points near x see more of it
template <typename Float>
Appearance<Float> appearance(const Row<Float> &row, KindSet kinds,
                             const mitsuba::Point<Float, 3> &x, float least) {
    return by_kind<Appearance<Float>>(
        row, kinds, [&](auto light) { return light.appearance(row, x, least); });
}

} // namespace manylights

#pragma once

/// Where shadow rays end.

#include "manylights/kinds/row.h"
#include <mitsuba/render/interaction.h>

namespace manylights {

/// Are intersections of a light exact enough? Those of far spheres and cylinders in single
/// precision are off by a share of the distance along their outline.
template <typename Float>
dr::mask_t<Float> may_end_close(const Row<Float> &row, const KindSet &kinds) {
    dr::mask_t<Float> result = true;
    for (LightKind round : { LightKind::Sphere, LightKind::Cylinder })
        if (kinds.has(round))
            result &= !row.is(round);
    return result;
}

/// How far from a surface at p Mitsuba's rays start
template <typename Float> Float ray_epsilon(const mitsuba::Point<Float, 3> &p) {
    return (1.f + dr::max(dr::abs(p))) * mitsuba::math::RayEpsilon<Float>;
}

/**
 * The ray from a surface or a point in a medium to a point of a light. Mitsuba's `spawn_ray_to`
 * ends it at a share of its length: far lamps shine through their shades, and bulbs with smooth
 * normals from behind. A `close` one ends as far before the light as rays start from a surface.
 */
template <typename Float, typename Spectrum>
mitsuba::Ray<mitsuba::Point<Float, 3>, Spectrum>
shadow_ray(const mitsuba::Interaction<Float, Spectrum> &from,
           const mitsuba::Point<Float, 3> &to, const dr::mask_t<Float> &close) {
    using mitsuba::math::ShadowEpsilon;
    auto ray                    = from.spawn_ray_to(to);
    Float distance              = ray.maxt / (1.f - ShadowEpsilon<Float>),
          gap                   = ray_epsilon<Float>(to);
    dr::masked(ray.maxt, close) = dr::maximum(ray.maxt, distance - gap);
    return ray;
}

} // namespace manylights

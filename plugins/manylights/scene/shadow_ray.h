#pragma once

/// Where shadow rays end.

#include <mitsuba/render/interaction.h>

namespace manylights {

/**
 * The ray from a surface or a point in a medium to a point of a light. It ends as far before the
 * light as rays start from a surface there. Mitsuba's `spawn_ray_to` ends it at a share of its
 * length: far lamps shine through their shades, and bulbs with smooth normals from behind.
 */
template <typename Float, typename Spectrum>
mitsuba::Ray<mitsuba::Point<Float, 3>, Spectrum>
shadow_ray(const mitsuba::Interaction<Float, Spectrum> &from,
           const mitsuba::Point<Float, 3> &to) {
    using mitsuba::math::RayEpsilon, mitsuba::math::ShadowEpsilon;
    auto ray       = from.spawn_ray_to(to);
    Float distance = ray.maxt / (1.f - ShadowEpsilon<Float>),
          gap      = (1.f + dr::max(dr::abs(to))) * RayEpsilon<Float>;
    ray.maxt       = dr::maximum(ray.maxt, distance - gap);
    return ray;
}

} // namespace manylights

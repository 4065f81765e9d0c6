#pragma once

#include <mitsuba/render/interaction.h>

namespace manylights {

/// A hit that no ray has found: `primitive` of a shape, at `uv` on it and at distance t
template <typename Float, typename Shape, typename UInt32, typename Point2f,
          typename Mask>
mitsuba::PreliminaryIntersection<Float, Shape> surface_hit(
    const typename mitsuba::PreliminaryIntersection<Float, Shape>::ShapePtr &shape,
    const UInt32 &primitive, const Point2f &uv, const Float &t, const Mask &valid) {
    // All that matters is set here: zeros() has an infinite distance
    auto hit       = dr::zeros<mitsuba::PreliminaryIntersection<Float, Shape>>();
    hit.valid      = valid;
    hit.t          = t;
    hit.prim_uv    = uv;
    hit.prim_index = primitive;
    hit.shape      = shape;
    return hit;
}

} // namespace manylights

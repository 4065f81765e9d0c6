#pragma once

/**
 * The light table on the host, before the tree gives it its order.
 */

#include "manylights/base/host_memory.h"
#include "manylights/kinds/row.h"
#include <mitsuba/render/emitter.h>
#include <mitsuba/render/shape.h>
#include <string>
#include <vector>

namespace manylights {

/// Primitives of one emissive shape -> lights: light_of_primitive[first + primitive]
template <typename Shape> struct ShapeLights {
    const Shape *shape;
    uint32_t first, count;
};

/// The table before the tree gives it its order
template <typename Float, typename Spectrum> struct HostTable {
    using Emitter = mitsuba::Emitter<Float, Spectrum>;
    using Shape   = mitsuba::Shape<Float, Spectrum>;

    HostVector<LightRow> rows;
    HostVector<LightBounds> bounds;
    KindSet kinds;
    /// Emitters without a place: environments, suns, directional lights
    std::vector<const Emitter *> infinite;
    std::vector<ShapeLights<Shape>> shapes;
    /// Index into `rows`, kOnlyHit, or kNone for a primitive that does not emit
    HostVector<uint32_t> light_of_primitive;
    /// Emitters whose emission is in proportion to that of each of their lights, of which
    /// none was left out
    std::vector<bool> proportional;
    /// Lights of any kind, those left out of the tree included
    uint32_t light_count = 0;
    /// Is there an emissive surface whose radiance is not in the table?
    bool needs_emitter_eval = false;
    /// Can a ray hit any light?
    bool can_be_hit = false;
    /// Emitters that only rays can find, and the name of the first one
    uint32_t only_hit = 0;
    std::string first_only_hit;
    /// Factor of all fluxes of `bounds`, see \ref flux_scale
    float scale = 1.f;
    /// Do narrow spots matter? The axes of all bounds are then mean directions of emission
    bool beams = false;
};

} // namespace manylights

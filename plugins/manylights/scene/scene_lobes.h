#pragma once

#include "manylights/receiver/lobes.h"
#include "scene_shapes.h"
#include <algorithm>
#include <mitsuba/render/bsdf.h>

namespace manylights {

/// The lobes that the surfaces of a scene have
template <typename Float, typename Spectrum>
Lobes find_lobes(const mitsuba::Scene<Float, Spectrum> *scene) {
    Lobes result = Lobes::None;
    for_each_shape(scene, [&](const auto *shape) {
        uint32_t flags = shape->bsdf() ? shape->bsdf()->flags() : 0;
        if (has_flag(flags, mitsuba::BSDFFlags::GlossyTransmission))
            result = Lobes::Transmitted;
        else if (has_flag(flags, mitsuba::BSDFFlags::Glossy))
            result = std::max(result, Lobes::Reflected);
    });
    return result;
}

} // namespace manylights

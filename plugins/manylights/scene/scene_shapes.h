#pragma once

#include <mitsuba/render/scene.h>

namespace manylights {

/// Call f(shape) for all shapes of a scene, and for those of its groups, whether or not there
/// are instances of these
template <typename Scene, typename F>
void for_each_shape(const Scene *scene, const F &f) {
    for (const auto &shape : scene->shapes())
        f(shape.get());
    for (const auto &group : scene->shapegroups())
        for (const auto &shape : group->shapes())
            f(shape.get());
}

} // namespace manylights

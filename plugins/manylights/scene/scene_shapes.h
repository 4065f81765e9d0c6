#pragma once

#include <mitsuba/render/scene.h>
#include <unordered_set>

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

/// How many BSDFs and emitters its shapes have: JIT variants record the code of each
template <typename Scene> size_t count_callables(const Scene *scene) {
    std::unordered_set<const mitsuba::Object *> callables;
    for_each_shape(scene, [&](const auto *shape) {
        callables.insert(shape->bsdf());
        callables.insert(shape->emitter());
    });
    callables.erase(nullptr);
    return callables.size();
}

} // namespace manylights

#pragma once

/**
 * The arrays that a scene of a JIT variant has of its emitters and shapes: by them dr.freeze tells
 * it from other scenes. Integrators that keep a scene's lights share one reference to them. While
 * there are others the scene lives: a reference to itself would be a circle if it has the integrator.
 */

#include "manylights/base/recording.h"
#include <memory>
#include <mitsuba/render/scene.h>
#include <mutex>
#include <unordered_map>

namespace manylights {

template <typename Float, typename Spectrum> class SceneArrays {
public:
    MI_IMPORT_TYPES(Scene, EmitterPtr, ShapePtr)

    explicit SceneArrays(const Scene *scene)
        : m_emitters(scene->emitters_dr()), m_shapes(scene->shapes_dr()) {}

    static std::shared_ptr<SceneArrays> of(const Scene *scene) {
        if constexpr (!dr::is_jit_v<Float>) {
            return nullptr;
        } else {
            static std::mutex mutex;
            static std::unordered_map<uint64_t, std::weak_ptr<SceneArrays>> known;
            std::lock_guard<std::mutex> guard(mutex);
            auto &slot  = known[scene->emitters_dr().index() +
                                ((uint64_t) scene->shapes_dr().index() << 32)];
            auto result = slot.lock();
            if (!result)
                slot = result = std::make_shared<SceneArrays>(scene);
            return result;
        }
    }

    bool has_scene() const { return is_shared(m_emitters) && is_shared(m_shapes); }

    MANYLIGHTS_TRAVERSE(m_emitters, m_shapes)

private:
    template <typename Array> static bool is_shared(const Array &array) {
        return !array.index() || jit_var_ref(array.index()) > 1;
    }

    mitsuba::DynamicBuffer<EmitterPtr> m_emitters;
    mitsuba::DynamicBuffer<ShapePtr> m_shapes;
};

} // namespace manylights

#pragma once

#include "fingerprint.h"
#include "media_kinds.h"
#include "scene_lobes.h"

namespace manylights {

/// All that the lights of a scene, and the way they are sampled, depend on. `literals`: see
/// Fingerprint::literals
template <typename Float, typename Spectrum>
Fingerprint<Float>
scene_fingerprint(const mitsuba::Scene<Float, Spectrum> *scene,
                  typename Fingerprint<Float>::Literals literals = {}) {
    Fingerprint<Float> result(scene->emitters().size(), std::move(literals));
    dr::mask_t<Float> active(true);
    for (const auto &emitter : scene->emitters()) {
        const auto *shape = emitter->shape();
        uint32_t flags    = emitter->flags(active);
        bool infinite     = has_flag(flags, mitsuba::EmitterFlags::Infinite);
        // Of those at infinity only pointers are kept
        if (infinite && !shape)
            result.add_untouched(emitter.get());
        else
            result.add_emitter(emitter.get());
        result.mix(flags);
        if (shape) {
            result.add(shape);
            result.mix(shape->has_flipped_normals());
        }
        // Kernels know them by number: another object may have got the address
        if constexpr (dr::is_jit_v<Float>)
            if (shape || infinite)
                result.mix(jit_registry_id(shape ? (const void *) shape
                                                 : (const void *) emitter.get()));
    }
    // The same emitters may belong to another scene: a new one that lies in memory
    // where a deleted one lay
    MediaKinds media = MediumReader<Float, Spectrum>::find(scene);
    result.mix_common((uint32_t) find_lobes<Float, Spectrum>(scene) + 4 * media.bits());
    return result;
}

} // namespace manylights

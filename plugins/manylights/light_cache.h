#pragma once

/**
 * Lights of the scenes that an integrator has met: built when a scene is first rendered,
 * and again when its emitters or their shapes have changed.
 *
 * Mitsuba has no hook before rendering. `render()` therefore calls \ref update, which
 * compares a fingerprint of the emitters; `sample()`, which other integrators may call on
 * their own, calls \ref get, which only compares the scene.
 */

#include "scene_lights.h"
#include <atomic>
#include <mitsuba/core/logger.h>
#include <mutex>
#include <sstream>

namespace manylights {

template <typename Float, typename Spectrum> class LightCache {
public:
    using Lights = SceneLights<Float, Spectrum>;
    using Scene  = mitsuba::Scene<Float, Spectrum>;

    explicit LightCache(bool keep_binary) : m_keep_binary(keep_binary) {}

    /// Make the lights of a scene current, and build them if they are new or changed
    const Lights &update(const Scene *scene) {
        refuse_freezing();
        std::lock_guard<std::mutex> guard(m_mutex);
        Fingerprint<Float> fingerprint = Lights::fingerprint(scene);
        for (const auto &entry : m_entries)
            if (entry && entry->scene == scene && entry->fingerprint == fingerprint)
                return select(entry.get());
        return select(build(scene, std::move(fingerprint)));
    }

    /// The lights of a scene; cheap enough for every ray of a scalar variant
    const Lights &get(const Scene *scene) const {
        const Entry *current = m_current.load(std::memory_order_acquire);
        if (current && current->scene == scene)
            return *current->lights;
        std::lock_guard<std::mutex> guard(m_mutex);
        for (const auto &entry : m_entries)
            if (entry && entry->scene == scene)
                return select(entry.get());
        refuse_freezing();
        return select(build(scene, Lights::fingerprint(scene)));
    }

    /// Expose the size of the current tree, read-only
    void traverse(mitsuba::TraversalCallback *cb) {
        auto read_only = mitsuba::ParamFlags::ReadOnly;
        if (const Entry *current = m_current.load())
            m_statistics = current->lights->statistics();
        cb->put("lights", m_statistics.lights, read_only);
        cb->put("lights_in_tree", m_statistics.lights_in_tree, read_only);
        cb->put("nodes", m_statistics.nodes, read_only);
        cb->put("depth", m_statistics.depth, read_only);
        cb->put("bytes", m_statistics.bytes, read_only);
        cb->put("build_ms", m_statistics.build_ms, read_only);
    }

    std::string to_string() const {
        const Entry *current = m_current.load();
        return current ? describe(current->lights->statistics()) : "[not built yet]";
    }

private:
    using Statistics = typename Lights::Statistics;

    struct Entry {
        const Scene *scene;
        Fingerprint<Float> fingerprint;
        mitsuba::ref<Lights> lights;
    };

    /// Takes the place of this scene's old lights, or of the scene that was built before last
    Entry *build(const Scene *scene, Fingerprint<Float> &&fingerprint) const {
        size_t slot = m_entries[0] && m_current.load() == m_entries[0].get() ? 1 : 0;
        for (size_t i = 0; i < 2; ++i)
            if (m_entries[i] && m_entries[i]->scene == scene)
                slot = i;
        mitsuba::ref<Lights> lights = new Lights(scene, m_keep_binary);
        Log(mitsuba::Info, "%s", describe(lights->statistics()));
        m_current = nullptr;
        m_entries[slot].reset(new Entry{ scene, std::move(fingerprint), lights });
        return m_entries[slot].get();
    }

    const Lights &select(Entry *entry) const {
        m_current.store(entry, std::memory_order_release);
        return *entry->lights;
    }

    static void refuse_freezing() {
        if constexpr (dr::is_jit_v<Float>)
            if (jit_flag(JitFlag::FreezingScope))
                throw std::runtime_error("manylights: rendering cannot be recorded by "
                                         "dr.freeze, because the light "
                                         "tree is built on the host. Call mi.render "
                                         "outside of the frozen function.");
    }

    static std::string describe(const Statistics &s) {
        std::ostringstream oss;
        oss << "LightTree[lights = " << s.lights
            << ", lights_in_tree = " << s.lights_in_tree << ", nodes = " << s.nodes
            << ", depth = " << s.depth
            << ", memory = " << mitsuba::util::mem_string((size_t) s.bytes)
            << ", built in " << mitsuba::util::time_string(s.build_ms, true) << "]";
        return oss.str();
    }

    bool m_keep_binary;
    mutable std::mutex m_mutex;
    mutable std::unique_ptr<Entry> m_entries[2];
    mutable std::atomic<Entry *> m_current{ nullptr };
    Statistics m_statistics;

    static constexpr const char *ClassName = "LightCache"; // for log messages
};

} // namespace manylights

#pragma once

/**
 * Lights of the scenes that an integrator has met: built when a scene is first rendered,
 * and again when its emitters or their shapes have changed.
 *
 * Mitsuba has no hook before rendering. `render()` holds a \ref Rendering, which compares a
 * fingerprint of the emitters once. Other integrators (`moment`, `stokes`) call `sample()`
 * alone: then the fingerprint is taken there, once for each recording in JIT variants, and in
 * scalar ones whenever a thread comes with another sampler, which it does for each of its
 * parts of an image.
 */

#include "scene_lights.h"
#include <atomic>
#include <mitsuba/core/logger.h>
#include <mitsuba/core/util.h>
#include <mitsuba/render/sampler.h>
#include <mutex>
#include <sstream>

namespace manylights {

template <typename Float, typename Spectrum> class LightCache {
public:
    using Lights  = SceneLights<Float, Spectrum>;
    using Scene   = mitsuba::Scene<Float, Spectrum>;
    using Sampler = mitsuba::Sampler<Float, Spectrum>;

    explicit LightCache(bool keep_binary) : m_keep_binary(keep_binary) {}

    /// Brings the lights of a scene up to date and vouches for them while it lives
    class Rendering {
    public:
        Rendering(const LightCache &cache, const Scene *scene) : m_cache(cache) {
            cache.update(scene);
            m_outer = cache.m_rendering.exchange(scene);
        }
        ~Rendering() { m_cache.m_rendering = m_outer; }
        Rendering(const Rendering &) = delete;

    private:
        const LightCache &m_cache;
        const Scene *m_outer;
    };

    /// The lights of a scene, for `sample()`; cheap enough for every ray
    const Lights &get(const Scene *scene, const Sampler *sampler) const {
        const Entry *current = m_current.load(std::memory_order_acquire);
        if (current && current->scene == scene && m_rendering == scene)
            return *current->lights;
        if constexpr (dr::is_jit_v<Float>) {
            (void) sampler;
            return update(scene);
        } else {
            thread_local Visit last;
            if (!last.is(this, scene, sampler))
                last.set(this, scene, sampler, update(scene));
            return *last.lights;
        }
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

    /// What a thread saw last. It keeps the sampler and the lights, so that no other can get
    /// their addresses; the references left at the end of a thread are not given back, since
    /// the thread may outlive this library.
    struct Visit {
        const LightCache *cache = nullptr;
        const Scene *scene      = nullptr;
        const Sampler *sampler  = nullptr;
        const Lights *lights    = nullptr;

        bool is(const LightCache *c, const Scene *sc, const Sampler *sa) const {
            return cache == c && scene == sc && sampler == sa;
        }

        void set(const LightCache *c, const Scene *sc, const Sampler *sa,
                 const Lights &l) {
            sa->inc_ref();
            l.inc_ref();
            if (sampler)
                sampler->dec_ref();
            if (lights)
                lights->dec_ref();
            *this = { c, sc, sa, &l };
        }
    };

    struct Entry {
        const Scene *scene;
        Fingerprint<Float> fingerprint;
        mitsuba::ref<Lights> lights;
    };

    /// Make the lights of a scene current, and build them if they are new or changed
    const Lights &update(const Scene *scene) const {
        refuse_freezing();
        std::lock_guard<std::mutex> guard(m_mutex);
        Fingerprint<Float> fingerprint = Lights::fingerprint(scene);
        for (const auto &entry : m_entries)
            if (entry && entry->scene == scene && entry->fingerprint == fingerprint)
                return select(entry.get());
        return select(build(scene, std::move(fingerprint)));
    }

    /// Takes the place of this scene's old lights, or of the scene that was built before last
    Entry *build(const Scene *scene, Fingerprint<Float> &&fingerprint) const {
        size_t slot = m_entries[0] && m_current.load() == m_entries[0].get() ? 1 : 0;
        for (size_t i = 0; i < 2; ++i)
            if (m_entries[i] && m_entries[i]->scene == scene)
                slot = i;
        mitsuba::ref<Lights> lights = new Lights(scene, m_keep_binary);
        Log(mitsuba::Info, "%s", describe(lights->statistics()));
        m_current = nullptr;
        // Another thread may still be rendering with what is replaced
        if (!m_rendering)
            m_retired.clear();
        if (m_entries[slot])
            m_retired.push_back(std::move(m_entries[slot]));
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
    mutable std::vector<std::unique_ptr<Entry>> m_retired;
    mutable std::atomic<Entry *> m_current{ nullptr };
    /// The scene whose lights `render()` has just checked
    mutable std::atomic<const Scene *> m_rendering{ nullptr };
    Statistics m_statistics;

    static constexpr const char *ClassName = "LightCache"; // for log messages
};

} // namespace manylights

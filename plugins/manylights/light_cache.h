#pragma once

/**
 * Lights of the scenes that an integrator has met: built when a scene is first rendered,
 * and again when its emitters or their shapes have changed. Where only the emission of
 * some emitters has changed, the tree stays and gets new fluxes.
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

    LightCache(bool keep_binary, bool finds_by_rays)
        : m_keep_binary(keep_binary), m_finds_by_rays(finds_by_rays) {}

private:
    struct Entry {
        const Scene *scene;
        Fingerprint<Float> fingerprint;
        mitsuba::ref<Lights> lights;
        /// How many calls of `render()` have checked these lights and go on
        std::atomic<uint32_t> renderings{ 0 };
    };

public:
    /// Brings the lights of a scene up to date and vouches for them while it lives. There
    /// may be several at once: nested ones, or those of threads that render other scenes.
    class Rendering {
    public:
        Rendering(const LightCache &cache, const Scene *scene) : m_cache(cache) {
            std::lock_guard<std::mutex> guard(cache.m_mutex);
            m_entry = &cache.update(scene);
            ++m_entry->renderings;
            ++cache.m_renderings;
        }
        ~Rendering() {
            std::lock_guard<std::mutex> guard(m_cache.m_mutex);
            --m_entry->renderings;
            --m_cache.m_renderings;
        }
        Rendering(const Rendering &) = delete;

        Lights &lights() const { return *m_entry->lights; }

    private:
        const LightCache &m_cache;
        Entry *m_entry;
    };

    /// The lights of a scene, for `sample()`; cheap enough for every ray
    const Lights &get(const Scene *scene, const Sampler *sampler) const {
        const Entry *current = m_current.load(std::memory_order_acquire);
        if (current && current->scene == scene && current->renderings > 0)
            return *current->lights;
        if constexpr (dr::is_jit_v<Float>) {
            (void) sampler;
            std::lock_guard<std::mutex> guard(m_mutex);
            return *update(scene).lights;
        } else {
            thread_local Visit last;
            if (!last.is(this, scene, sampler)) {
                std::lock_guard<std::mutex> guard(m_mutex);
                last.set(this, scene, sampler, *update(scene).lights);
            }
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

    /// Make the lights of a scene current, and build or refit them if they are new or changed
    Entry &update(const Scene *scene) const {
        refuse_freezing();
        Fingerprint<Float> fingerprint = Lights::fingerprint(scene);
        for (const auto &entry : m_entries)
            if (entry && entry->scene == scene &&
                (entry->fingerprint == fingerprint || refit(*entry, fingerprint)))
                return select(entry.get());
        fingerprint.hold();
        return select(build(scene, std::move(fingerprint)));
    }

    /// If emitters have only become brighter or darker, and nobody uses the lights
    bool refit(Entry &entry, Fingerprint<Float> &fingerprint) const {
        if (m_keep_binary || entry.renderings > 0 ||
            !fingerprint.same_places(entry.fingerprint))
            return false;
        std::vector<uint32_t> changed = fingerprint.changed_emission(entry.fingerprint);
        // Single ones are faster read where they are
        std::vector<uint32_t> none;
        DeviceScalars<Float> scalars(changed.size() < 100 ? none
                                                          : fingerprint.variables());
        // Until it has succeeded they are the lights of no scene
        entry.fingerprint = Fingerprint<Float>(0);
        if (!entry.lights->refit(entry.scene, changed))
            return false;
        fingerprint.hold();
        entry.fingerprint = std::move(fingerprint);
        Log(mitsuba::Info, "%s", describe(entry.lights->statistics()));
        return true;
    }

    /// Takes the place of this scene's old lights, or of the scene that was built before last
    Entry *build(const Scene *scene, Fingerprint<Float> &&fingerprint) const {
        size_t slot = m_entries[0] && m_current.load() == m_entries[0].get() ? 1 : 0;
        for (size_t i = 0; i < 2; ++i)
            if (m_entries[i] && m_entries[i]->scene == scene)
                slot = i;
        DeviceScalars<Float> scalars(fingerprint.variables());
        mitsuba::ref<Lights> lights = new Lights(scene, m_keep_binary);
        Log(mitsuba::Info, "%s", describe(lights->statistics()));
        if (!m_finds_by_rays)
            lights->warn_of_lights_for_rays();
        m_current = nullptr;
        // Another thread may still be rendering with what is replaced
        if (m_renderings == 0)
            m_retired.clear();
        if (m_entries[slot])
            m_retired.push_back(std::move(m_entries[slot]));
        m_entries[slot].reset(new Entry{ scene, std::move(fingerprint), lights });
        return m_entries[slot].get();
    }

    Entry &select(Entry *entry) const {
        m_current.store(entry, std::memory_order_release);
        return *entry;
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
            << (s.refit_ms > 0 ? ", refit in " : ", built in ")
            << mitsuba::util::time_string(s.refit_ms > 0 ? s.refit_ms : s.build_ms, true)
            << "]";
        return oss.str();
    }

    bool m_keep_binary;
    /// Do rays that leave surfaces find lights?
    bool m_finds_by_rays;
    mutable std::mutex m_mutex;
    mutable std::unique_ptr<Entry> m_entries[2];
    mutable std::vector<std::unique_ptr<Entry>> m_retired;
    mutable std::atomic<Entry *> m_current{ nullptr };
    /// Of all scenes
    mutable uint32_t m_renderings = 0;
    Statistics m_statistics;

    static constexpr const char *ClassName = "LightCache"; // for log messages
};

} // namespace manylights

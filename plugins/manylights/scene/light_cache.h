#pragma once

/**
 * Lights of the scenes that an integrator has met: built when a scene is first rendered,
 * and again when its emitters or their shapes have changed. Where only the emission of
 * some emitters has changed, the tree stays and gets new fluxes.
 *
 * Mitsuba has no hook before rendering. `render()` holds a \ref Rendering, which compares a
 * fingerprint of the emitters once. Otherwise it is compared whenever `sample()` is called:
 * once for each recording in JIT variants. In scalar ones, where that would be once for each
 * ray of an integrator around this one (`moment`, `stokes`), only when a thread comes with
 * another sampler. Such renderings fork one for each part of an image; the sampler of a
 * program, which may change the scene between two calls, is known by belonging to Python.
 *
 * A function that dr.freeze records cannot build lights: they are brought up to date before, whenever
 * dr.freeze looks for the arrays that the function depends on.
 */

#include "lamp_cache.h"
#include "manylights/choice/parameters.h"
#include "scene_arrays.h"
#include "scene_fingerprint.h"
#include "scene_lights.h"
#include <atomic>
#include <memory>
#include <mitsuba/core/logger.h>
#include <mitsuba/core/util.h>
#include <mitsuba/render/sampler.h>
#include <mutex>
#include <sstream>
#include <thread>
#include <unordered_map>

namespace manylights {

template <typename Float, typename Spectrum> class LightCache {
public:
    using Lights = SceneLights<Float, Spectrum>;
    MI_IMPORT_TYPES(Scene, Sampler)

    explicit LightCache(const SamplingParameters &params) : m_params(params) {}

private:
    /// The lights of a scene as it was; those who use them keep it
    struct Entry {
        const Scene *scene;
        std::shared_ptr<SceneArrays<Float, Spectrum>> arrays;
        Fingerprint<Float> fingerprint;
        mitsuba::ref<Lights> lights;
        LampCache<Float, Spectrum> lamps;
        /// How many calls of `render()` have checked these lights and go on
        uint32_t renderings = 0;

        Entry(const Scene *scene, Fingerprint<Float> &&fingerprint,
              mitsuba::ref<Lights> lights)
            : scene(scene), arrays(SceneArrays<Float, Spectrum>::of(scene)),
              fingerprint(std::move(fingerprint)), lights(lights) {}

        MANYLIGHTS_TRAVERSE(arrays, lights)
    };
    using EntryPtr = std::shared_ptr<Entry>;

public:
    /// Brings the lights of a scene up to date and vouches for them while it lives. There
    /// may be several at once: nested ones, or those of threads that render other scenes.
    class Rendering {
    public:
        Rendering(const LightCache &cache, const Scene *scene) : m_cache(cache) {
            std::lock_guard<std::mutex> guard(cache.m_mutex);
            m_entry = cache.update(scene);
            ++m_entry->renderings;
        }
        ~Rendering() {
            std::lock_guard<std::mutex> guard(m_cache.m_mutex);
            --m_entry->renderings;
        }
        Rendering(const Rendering &) = delete;

        Lights &lights() const { return *m_entry->lights; }

        /// Those that are small on the film of a sensor, null if there are none. For one thread
        /// at a time
        std::shared_ptr<const LampsInView<Float, Spectrum>>
        lamps(const mitsuba::Sensor<Float, Spectrum> *sensor,
              const mitsuba::Vector<uint32_t, 2> &size) const {
            return m_entry->lamps.find(lights(), sensor, size);
        }

    private:
        const LightCache &m_cache;
        EntryPtr m_entry;
    };

    /// Lights in use, kept alive if nobody else does
    class Use {
    public:
        explicit Use(const Lights *lights) : m_lights(lights) {}
        explicit Use(const mitsuba::ref<Lights> &lights)
            : m_lights(lights.get()), m_kept(lights) {}
        const Lights &operator*() const { return *m_lights; }

    private:
        const Lights *m_lights;
        mitsuba::ref<Lights> m_kept;
    };

    /// The lights of a scene, for `sample()`; cheap enough for every ray
    Use get(const Scene *scene, const Sampler *sampler) const {
        if constexpr (!dr::is_jit_v<Float>) {
            thread_local Visit last;
            if (last.is(m_serial, scene, sampler))
                return Use(last.lights);
            if (!sampler->self_py()) {
                last = visit(scene, sampler);
                return Use(last.lights);
            }
        }
        std::lock_guard<std::mutex> guard(m_mutex);
        return Use(vouched_or_updated(scene)->lights);
    }

    /// Forget what was learnt of the visibility of all lights
    void forget_visibility() {
        std::lock_guard<std::mutex> guard(m_mutex);
        for (const EntryPtr &entry : m_entries)
            if (entry) {
                entry->lights->change_learner(
                    [](auto &l) { l.stop(/* keep = */ false); });
                entry->lights->set_group_levels({});
            }
    }

    /// Bring the lights of all scenes up to date. Returns what is no array, see HostFacts
    uint64_t prepare_recording() const {
        std::lock_guard<std::mutex> guard(m_mutex);
        const Scene *current = m_current ? m_current->scene : nullptr;
        Hash facts;
        for (EntryPtr &entry : m_entries) {
            if (entry && !entry->arrays->has_scene())
                entry.reset();
            if (entry && entry->renderings == 0)
                update(entry->scene);
            facts.mix(entry != nullptr);
            if (entry)
                entry->lights->add_facts(facts, m_params);
        }
        for (EntryPtr &entry : m_entries)
            if (entry && entry->scene == current)
                m_current = entry;
        return facts.value;
    }

    /// The lights of a scene as they are, null if it is not known or gone
    mitsuba::ref<Lights> find(const Scene *scene) const {
        std::lock_guard<std::mutex> guard(m_mutex);
        for (const EntryPtr &entry : m_entries)
            if (entry && entry->scene == scene)
                return entry->lights;
        return nullptr;
    }

    /// What dr.freeze has to know
    MANYLIGHTS_TRAVERSE(m_entries)

    /// Expose the size of the current tree, read-only
    void traverse(mitsuba::TraversalCallback *cb) {
        auto read_only = mitsuba::ParamFlags::ReadOnly;
        std::lock_guard<std::mutex> guard(m_mutex);
        if (m_current)
            m_statistics = m_current->lights->statistics();
        cb->put("lights", m_statistics.lights, read_only);
        cb->put("lights_in_tree", m_statistics.lights_in_tree, read_only);
        cb->put("nodes", m_statistics.nodes, read_only);
        cb->put("depth", m_statistics.depth, read_only);
        cb->put("bytes", m_statistics.bytes, read_only);
        cb->put("build_ms", m_statistics.build_ms, read_only);
    }

    std::string to_string() const {
        std::lock_guard<std::mutex> guard(m_mutex);
        return m_current ? describe(m_current->lights->statistics()) : "[not built yet]";
    }

private:
    using Statistics = typename Lights::Statistics;

    /// What a thread saw last. The cache of this number keeps sampler and lights, so that no
    /// others can get their addresses. Threads outlive caches, and keep nothing of them.
    struct Visit {
        uint64_t cache         = 0;
        const Scene *scene     = nullptr;
        const Sampler *sampler = nullptr;
        const Lights *lights   = nullptr;

        bool is(uint64_t c, const Scene *sc, const Sampler *sa) const {
            return cache == c && scene == sc && sampler == sa;
        }
    };

    /// A thread comes with a new sampler
    Visit visit(const Scene *scene, const Sampler *sampler) const {
        std::lock_guard<std::mutex> guard(m_mutex);
        Visited &visited = m_visited[std::this_thread::get_id()];
        visited          = { mitsuba::ref<Sampler>(const_cast<Sampler *>(sampler)),
                             vouched_or_updated(scene)->lights };
        return { m_serial, scene, sampler, visited.lights.get() };
    }

    /// Renderings have checked their lights when they began
    EntryPtr vouched_or_updated(const Scene *scene) const {
        for (const EntryPtr &entry : m_entries)
            if (entry && entry->scene == scene && entry->renderings > 0)
                return entry;
        return update(scene);
    }

    /// Make the lights of a scene current, and build or refit them if they are new or changed
    EntryPtr update(const Scene *scene) const {
        if (is_recorded<Float>())
            return m_current = recorded(scene);
        Fingerprint<Float> fingerprint = scene_fingerprint<Float, Spectrum>(scene);
        for (const EntryPtr &entry : m_entries)
            if (entry && entry->scene == scene &&
                (entry->fingerprint == fingerprint || refit(*entry, fingerprint))) {
                entry->lights->set_size(scene);
                return m_current = entry;
            }
        fingerprint.hold();
        m_current = build(scene, std::move(fingerprint));
        m_current->lights->set_size(scene);
        return m_current;
    }

    /// In a function that dr.freeze records: those that are up to date, or it cannot be recorded
    EntryPtr recorded(const Scene *scene) const {
        RecordingPause<Float> pause;
        for (const EntryPtr &entry : m_entries) {
            if (!entry || entry->scene != scene)
                continue;
            auto now = scene_fingerprint<Float, Spectrum>(scene);
            if (entry->fingerprint == now ||
                entry->fingerprint == scene_fingerprint<Float, Spectrum>(
                                          scene, now.literals(entry->fingerprint)))
                return entry;
            throw std::runtime_error(
                "manylights: the lights of the scene have changed within the function "
                "that dr.freeze records, but their tree is built on the host. Change "
                "them "
                "outside of the frozen function, and give it the integrator as an "
                "argument.");
        }
        throw std::runtime_error(
            "manylights: dr.freeze cannot record how the light tree of a scene is built, "
            "because that is done on the host. Before the first call, call mi.render "
            "outside of the frozen function, with the same scene and integrator and one "
            "sample per pixel.");
    }

    /// If emitters have only become brighter or darker, and nobody uses the lights
    bool refit(Entry &entry, Fingerprint<Float> &fingerprint) const {
        if (m_params.splits_nodes() || entry.renderings > 0 ||
            !fingerprint.same_places(entry.fingerprint))
            return false;
        auto changed = fingerprint.changed_emission(entry.fingerprint);
        // Single ones are faster read where they are
        std::vector<uint32_t> none;
        DeviceScalars<Float> scalars(changed.size() < 100 ? none
                                                          : fingerprint.variables());
        // Until it has succeeded they are the lights of no scene
        entry.fingerprint = Fingerprint<Float>(0);
        entry.lamps.clear();
        if (!entry.lights->refit(entry.scene, changed))
            return false;
        fingerprint.hold();
        entry.fingerprint = std::move(fingerprint);
        Log(mitsuba::Info, "%s", describe(entry.lights->statistics()));
        return true;
    }

    /// Takes the place of this scene's old lights, or of the scene that was built before last
    EntryPtr build(const Scene *scene, Fingerprint<Float> &&fingerprint) const {
        size_t slot = m_entries[0] && m_current == m_entries[0] ? 1 : 0;
        for (size_t i = 0; i < 2; ++i)
            if (m_entries[i] && m_entries[i]->scene == scene)
                slot = i;
        DeviceScalars<Float> scalars(fingerprint.variables());
        mitsuba::ref<Lights> lights =
            new Lights(scene, m_params.splits_nodes(), m_params.light_groups);
        Log(mitsuba::Info, "%s", describe(lights->statistics()));
        // No rays that leave surfaces find lights
        if (m_params.bsdf_samples == 0)
            lights->warn_of_lights_for_rays();
        m_entries[slot] =
            std::make_shared<Entry>(scene, std::move(fingerprint), std::move(lights));
        return m_entries[slot];
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

    /// No two caches have the same number, even if one lies where the other lay
    static uint64_t next_serial() {
        static std::atomic<uint64_t> count{ 0 };
        return ++count;
    }

    /// What a thread uses
    struct Visited {
        mitsuba::ref<Sampler> sampler;
        mitsuba::ref<Lights> lights;
    };

    const SamplingParameters &m_params;
    const uint64_t m_serial = next_serial();
    /// For all of the following
    mutable std::mutex m_mutex;
    mutable EntryPtr m_entries[2], m_current;
    mutable std::unordered_map<std::thread::id, Visited> m_visited;
    Statistics m_statistics;

    static constexpr const char *ClassName = "LightCache"; // for log messages
};

} // namespace manylights

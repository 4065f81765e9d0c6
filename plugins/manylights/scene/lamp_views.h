#pragma once

/**
 * Cameras that an integrator has rendered, and their lamps: for functions that dr.freeze records,
 * where none can be chosen. They follow changes whenever dr.freeze looks for arrays.
 */

#include "lamps_in_view.h"
#include <algorithm>
#include <mitsuba/render/sampler.h>
#include <stdexcept>

namespace manylights {

template <typename Float, typename Spectrum> class LampViews {
public:
    MI_IMPORT_TYPES(Scene, Sensor)
    using Lamps  = LampsInView<Float, Spectrum>;
    using Lights = typename Lamps::Lights;
    using Size   = mitsuba::Vector<uint32_t, 2>;

    /**
     * Those of a view from now on.
     * @param cache  tells the lights of a scene, null if that is not known any more
     */
    template <typename Cache>
    void remember(const Scene *scene, Sensor *sensor, const Cache &cache) {
        if constexpr (dr::is_jit_v<Float>) {
            const auto &own = scene->sensors();
            bool foreign = std::none_of(own.begin(), own.end(),
                                        [&](const auto &each) { return each == sensor; });
            auto replaced = [&](const View &view) {
                bool same = view.scene == scene && view.sensor == sensor;
                return !same && ((foreign && view.kept) || !cache.find(view.scene));
            };
            m_views.erase(std::remove_if(m_views.begin(), m_views.end(), replaced),
                          m_views.end());
            for (const View &view : m_views)
                if (view.scene == scene && view.sensor == sensor)
                    return;
            m_views.emplace_back();
            m_views.back().scene  = scene;
            m_views.back().sensor = sensor;
            if (foreign)
                m_views.back().kept = sensor;
        }
    }

    /**
     * Follow all changes. Adds what is no array, see HostFacts.
     * @param cache      see above; it knows no scene that is gone
     * @param film_size  how many pixels of a film are rendered
     */
    template <typename Cache, typename FilmSize>
    void prepare(const Cache &cache, const FilmSize &film_size, Hash &facts) {
        for (size_t i = 0; i < m_views.size();) {
            mitsuba::ref<Lights> lights = cache.find(m_views[i].scene);
            if (!lights) {
                m_views.erase(m_views.begin() + i);
                continue;
            }
            View &view = m_views[i++];
            update(view, lights, film_size(view.sensor->film()));
            facts.mix(view.sensor->sampler()->sample_count());
            facts.mix(view.lamps ? view.lamps->points() : 0u);
            facts.mix(view.camera.lens + 2 * (uint64_t) view.size.x() +
                      ((uint64_t) view.size.y() << 32));
        }
    }

    /// The lamps that were prepared for a view. They are those of other lights or another
    /// camera if these have changed since
    std::shared_ptr<Lamps> find(const Scene *scene, const Sensor *sensor,
                                const Lights &lights, const Size &size) const {
        RecordingPause<Float> pause;
        if (!Lamps::may_find(lights, sensor))
            return {};
        for (const View &view : m_views)
            if (view.scene == scene && view.sensor == sensor && view.lights == &lights &&
                dr::all(view.size == size) && view.camera == read_view(sensor))
                return view.lamps;
        throw std::runtime_error(
            "manylights: dr.freeze cannot record how lamps are chosen that are small on "
            "the film, because that is done on the host. Before the first call, call "
            "mi.render outside of the frozen function with the same sensor, and move "
            "that "
            "outside of it only.");
    }

    MANYLIGHTS_TRAVERSE(m_views)

private:
    struct View {
        const Scene *scene = nullptr;
        /// The scene's own ones live as long as it does, of others the last one is kept
        Sensor *sensor = nullptr;
        mitsuba::ref<Sensor> kept;
        mitsuba::ref<Lights> lights;
        uint32_t version = 0;
        Size size        = 0;
        CameraView<float> camera;
        std::shared_ptr<Lamps> lamps;

        MANYLIGHTS_TRAVERSE(lamps)
    };

    static void update(View &view, const mitsuba::ref<Lights> &lights, const Size &size) {
        CameraView<float> camera;
        bool may_find = Lamps::may_find(*lights, view.sensor);
        if (may_find)
            camera = read_view(view.sensor);
        if (view.lights == lights && view.version == lights->version() &&
            dr::all(view.size == size) && (!may_find || view.camera == camera))
            return;
        view.lights  = lights;
        view.version = lights->version();
        view.size    = size;
        view.camera  = camera;
        view.lamps   = nullptr;
        if (may_find)
            view.lamps = Lamps::choose(*lights, camera, size, Lamps::border(view.sensor));
        if (view.lamps)
            view.lamps->round_points();
    }

    std::vector<View> m_views;
};

} // namespace manylights

#pragma once

/**
 * Cameras that an integrator has rendered, and their lamps: for functions that dr.freeze records,
 * where none can be chosen. They follow changes whenever dr.freeze looks for arrays.
 */

#include "lamps_in_view.h"
#include <stdexcept>

namespace manylights {

template <typename Float, typename Spectrum> class LampViews {
public:
    MI_IMPORT_TYPES(Scene, Sensor)
    using Lamps  = LampsInView<Float, Spectrum>;
    using Lights = typename Lamps::Lights;
    using Size   = mitsuba::Vector<uint32_t, 2>;

    /// Those of a view from now on, of all that are remembered the last ones
    void remember(const Scene *scene, Sensor *sensor) {
        if constexpr (dr::is_jit_v<Float>) {
            for (const View &view : m_views)
                if (view.scene == scene && view.sensor == sensor)
                    return;
            if (m_views.size() == kMost)
                m_views.erase(m_views.begin());
            m_views.emplace_back();
            m_views.back().scene  = scene;
            m_views.back().sensor = sensor;
        }
    }

    /**
     * Follow all changes. Adds what is no array, see HostFacts.
     * @param lights_of  those of a scene, null if that is gone
     * @param size_of    how many pixels of a sensor are rendered
     */
    template <typename LightsOf, typename SizeOf>
    void prepare(const LightsOf &lights_of, const SizeOf &size_of, Hash &facts) {
        for (size_t i = 0; i < m_views.size();) {
            mitsuba::ref<Lights> lights = lights_of(m_views[i].scene);
            if (!lights) {
                m_views.erase(m_views.begin() + i);
                continue;
            }
            View &view = m_views[i++];
            update(view, lights, size_of(view.sensor.get()));
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
    static constexpr size_t kMost = 4;

    struct View {
        const Scene *scene = nullptr;
        mitsuba::ref<Sensor> sensor;
        mitsuba::ref<Lights> lights;
        uint32_t version = 0;
        Size size        = 0;
        CameraView<float> camera;
        std::shared_ptr<Lamps> lamps;

        MANYLIGHTS_TRAVERSE(lamps)
    };

    static void update(View &view, const mitsuba::ref<Lights> &lights, const Size &size) {
        CameraView<float> camera;
        bool may_find = Lamps::may_find(*lights, view.sensor.get());
        if (may_find)
            camera = read_view(view.sensor.get());
        if (view.lights == lights && view.version == lights->version() &&
            dr::all(view.size == size) && (!may_find || view.camera == camera))
            return;
        view.lights  = lights;
        view.version = lights->version();
        view.size    = size;
        view.camera  = camera;
        view.lamps   = nullptr;
        if (may_find)
            view.lamps = Lamps::find(*lights, view.sensor.get(), size, camera);
        if (view.lamps)
            view.lamps->round_points();
    }

    std::vector<View> m_views;
};

} // namespace manylights

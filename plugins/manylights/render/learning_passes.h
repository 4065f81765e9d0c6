#pragma once

/**
 * What is learnt while rendering: visibility, from the shadow rays of a first pass, at most a
 * sixteenth of the samples, and of a second one if the first promises much; more passes teach
 * little. All other samples are rendered in one pass, whose pattern is then as whole as it can
 * be; in JIT variants each pass is recorded anew.
 */

#include "manylights/choice/parameters.h"
#include "manylights/scene/scene_lights.h"
#include "passes.h"
#include <mitsuba/render/sensor.h>

namespace manylights {

template <typename Float, typename Spectrum> class LearningPasses {
public:
    MI_IMPORT_TYPES(Scene, Sensor, Sampler)
    using Lights = SceneLights<Float, Spectrum>;

    /// `running`: set as long as this learns
    LearningPasses(Lights &lights, const SamplingParameters &params, bool &running)
        : m_lights(lights), m_params(params), m_running(running) {}
    ~LearningPasses() {
        if (!m_wanted)
            return;
        m_running = false;
        m_lights.stop_learning(keeps());
    }
    LearningPasses(const LearningPasses &) = delete;

    /// Begin to learn, if that is wanted and pays off
    void start(const Scene *scene, Sensor *sensor, uint32_t spp) {
        if (m_params.learn_visibility == LearnVisibility::No ||
            m_params.considers_all(m_lights.tree().light_count) ||
            has_entry_for_each_sample(sensor))
            return;
        Sampler *sampler = sensor->sampler();
        if (spp)
            sampler->set_sample_count(spp);
        spp             = sampler->sample_count();
        uint32_t pixels = dr::prod(film_size(sensor->film()));
        double total    = (double) pixels * spp;
        m_training      = training_samples(spp, pixels);
        if (spp < kLeastSamples || total < kLeastTotal || total > kMostTotal)
            return;
        m_lights.start_learning(scene, cell_size(scene, sensor), total, keeps());
        m_running = m_wanted = true;
    }

    bool wanted() const { return m_wanted; }

    /// Returns the samples per pixel of a pass, of `left` that have not been rendered
    uint32_t start_pass(uint32_t pass, uint32_t left) {
        if (pass > 0 && m_trains)
            m_trains = m_lights.learn(/* go_on = */ pass < kTraining);
        return m_trains ? std::min(m_training, left) : left;
    }

private:
    static constexpr uint32_t kTraining = 2;
    /// The image has the noise of these samples, too: more of them cost more than they teach
    static constexpr uint32_t kTrainingTotal = 1 << 16;
    /// Of three, the first would be a large part, and it is the slowest
    static constexpr uint32_t kLeastSamples = 4;
    /// A wavefront has less than 2^32 lanes, and some may be left over
    static constexpr double kMostTotal =
        dr::is_jit_v<Float> ? 0x1p31 : dr::Infinity<double>;
    /// With fewer samples, recording one more pass takes longer than it may gain
    static constexpr double kLeastTotal =
        dr::is_cuda_v<Float> ? 0x1p23 : (dr::is_llvm_v<Float> ? 0x1p19 : 0);

    bool keeps() const { return m_params.learn_visibility == LearnVisibility::Keep; }

    /// Per pixel: kTrainingTotal in the image if a sixteenth of all are as many, and a divisor
    static uint32_t training_samples(uint32_t spp, uint32_t pixels) {
        uint32_t enough  = (kTrainingTotal + pixels - 1) / pixels,
                 samples = std::max(std::min(spp / 16, enough), 1u);
        while (spp % samples)
            --samples;
        return samples;
    }

    static CellSize cell_size(const Scene *scene, const Sensor *sensor) {
        CellSize result;
        auto camera = sensor->world_transform().translation();
        for (size_t i = 0; i < 3; ++i) {
            if constexpr (dr::is_jit_v<Float>)
                result.camera[i] = (float) dr::slice(dr::detach(camera.entry(i)));
            else
                result.camera[i] = (float) camera.entry(i);
        }
        result.scene = (float) dr::norm(scene->bbox().extents());
        return result;
    }

    /// Does a parameter of the sensor have one entry for each sample of a rendering? All
    /// samples are then rendered at once.
    static bool has_entry_for_each_sample(const Sensor *sensor) {
        struct Visitor : mitsuba::TraversalCallback {
            size_t entries = 1;
            void put_value(std::string_view, void *value, uint32_t,
                           const std::type_info &type) override {
                if (type == typeid(Float))
                    entries = std::max(entries, dr::width(*(const Float *) value));
            }
            void put_object(std::string_view, mitsuba::Object *, uint32_t) override {}
        } visitor;
        if constexpr (dr::is_jit_v<Float>) {
            visitor.entries = dr::width(sensor->world_transform().matrix);
            const_cast<Sensor *>(sensor)->traverse(&visitor);
        }
        return visitor.entries > 1;
    }

    Lights &m_lights;
    const SamplingParameters &m_params;
    bool &m_running;
    bool m_wanted = false, m_trains = true;
    /// Samples per pixel of a training pass
    uint32_t m_training = 0;
};

} // namespace manylights

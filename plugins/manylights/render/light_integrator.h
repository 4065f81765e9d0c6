#pragma once

/**
 * What the integrators have in common: parameters, the lights of the scene, and rendering in
 * passes between which their visibility is learnt (learning_passes.h).
 */

#include "camera_sample.h"
#include "color_tables.h"
#include "film_channels.h"
#include "first_hit.h"
#include "lamp_splats.h"
#include "learning_passes.h"
#include "manylights/scene/light_cache.h"
#include "ordered_blocks.h"
#include "wavefronts.h"
#include <mitsuba/render/integrator.h>
#include <mitsuba/render/sensor.h>

namespace manylights {

/// True for a while
struct Flag {
    bool &flag;
    explicit Flag(bool &flag) : flag(flag) { flag = true; }
    ~Flag() { flag = false; }
    Flag(const Flag &) = delete;
};

template <typename Float, typename Spectrum,
          template <typename, typename> typename BaseIntegrator>
class LightIntegrator : public BaseIntegrator<Float, Spectrum> {
public:
    MI_IMPORT_BASE(BaseIntegrator, m_block_size, m_samples_per_pass, m_stop,
                   m_render_timer, m_timeout, should_stop, m_hide_emitters)
    MI_IMPORT_TYPES(Scene, Sensor, Sampler, Film, ImageBlock, Medium)
    using Cache    = LightCache<Float, Spectrum>;
    using Lights   = typename Cache::Lights;
    using Pass     = manylights::Pass<Float, Spectrum>;
    using Learning = LearningPasses<Float, Spectrum>;
    using Lamps    = LampsInView<Float, Spectrum>;

    LightIntegrator(const mitsuba::Properties &props, const SamplingParameters &params)
        : Base(props), m_params(params), m_aovs(read_aovs(props)), m_cache(m_params),
          m_channels(m_params, m_aovs), m_learning(m_params) {}

    /**
     * As `sample`, with the weight of the ray for the layers of light groups (null: that of a
     * sensor without a response of its own), which are the only ones that need it
     */
    virtual std::pair<Spectrum, Mask>
    sample_weighted(const Scene *scene, Sampler *sampler, const RayDifferential3f &ray,
                    const Spectrum *weight, const Medium *medium, Float *aovs,
                    Mask active) const = 0;

    std::pair<Spectrum, Mask> sample(const Scene *scene, Sampler *sampler,
                                     const RayDifferential3f &ray, const Medium *medium,
                                     Float *aovs, Mask active) const override {
        return sample_weighted(scene, sampler, ray, nullptr, medium, aovs, active);
    }

    /// One of a scalar variant, in place of that of Mitsuba where layers need its weight
    void render_sample(const Scene *scene, const Sensor *sensor, Sampler *sampler,
                       ImageBlock *block, Float *aovs, const Vector2f &pixel,
                       ScalarFloat scale, Mask active = true) const {
        if (m_params.light_groups.empty())
            return Base::render_sample(scene, sensor, sampler, block, aovs, pixel, scale,
                                       active);
        CameraSample<Float, Spectrum, LightIntegrator> sample(*this, scene, sensor,
                                                              sampler);
        Vector2f offset = sample.render(pixel, scale, aovs, active);
        bool box        = sensor->film()->rfilter()->is_box_filter();
        block->put(box ? pixel : pixel + offset, aovs, active);
    }

    TensorXf render(Scene *scene, Sensor *sensor, UInt32 seed, uint32_t spp, bool develop,
                    bool evaluate) override {
        // Mitsuba's threads do, the main thread does not: bits would depend on who renders what
        dr::scoped_flush_denormals flush(true);
        auto lock = lock_rendering();
        typename Cache::Rendering guard(m_cache, scene);
        prepare_channels(scene, sensor->film());
        if (m_rendering || m_differentiating || m_samples_per_pass != kOnePass ||
            has_entry_for_each_sample(sensor))
            return Base::render(scene, sensor, seed, spp, develop, evaluate);
        Flag rendering(m_rendering);
        return render_passes(guard, scene, sensor, seed, spp, develop, evaluate);
    }

    TensorXf render_forward(Scene *scene, void *params, Sensor *sensor, UInt32 seed,
                            uint32_t spp) override {
        auto lock = lock_rendering();
        Flag guard(m_differentiating);
        return Base::render_forward(scene, params, sensor, seed, spp);
    }

    void render_backward(Scene *scene, void *params, const TensorXf &grad_in,
                         Sensor *sensor, UInt32 seed, uint32_t spp) override {
        auto lock = lock_rendering();
        Flag guard(m_differentiating);
        Base::render_backward(scene, params, grad_in, sensor, seed, spp);
    }

    std::vector<std::string> aov_names() const override { return m_channels.names; }

    /// How many of these describe surfaces: what else is computed does not depend on them
    size_t aov_count() const { return m_channels.aov_count(); }

    void traverse(mitsuba::TraversalCallback *cb) override {
        Base::traverse(cb);
        m_cache.traverse(cb);
        cb->put("plan", m_plan_numbers, mitsuba::ParamFlags::NonDifferentiable);
        m_learning.traverse(cb);
    }

    void traverse_1_cb_ro(void *payload,
                          dr::detail::traverse_callback_ro fn) const override {
        if constexpr (dr::is_jit_v<Float>) {
            if (!jit_flag(JitFlag::EnableObjectTraversal))
                return;
            if (!is_recorded<Float>())
                prepare_recording();
            DRJIT_MAP(DR_TRAVERSE_MEMBER_RO, m_facts, m_cache, m_views, m_learning,
                      m_shape_numbers, m_color_tables)
        }
    }
    void traverse_1_cb_rw(void *payload, dr::detail::traverse_callback_rw fn) override {
        if constexpr (dr::is_jit_v<Float>) {
            if (!jit_flag(JitFlag::EnableObjectTraversal))
                return;
            DRJIT_MAP(DR_TRAVERSE_MEMBER_RW, m_facts, m_cache, m_views, m_learning,
                      m_shape_numbers, m_color_tables)
        }
    }

    void parameters_changed(const std::vector<std::string> &keys) override {
        Base::parameters_changed(keys);
        auto written = [&](std::string_view name) {
            return std::any_of(keys.begin(), keys.end(), [&](std::string_view key) {
                return key == name || key == name.substr(name.rfind('.') + 1);
            });
        };
        if (keys.empty() || written("plan"))
            set_plan();
        if (keys.empty() || written("visibility.counts"))
            m_learning.set_written();
    }

protected:
    using Sums = GroupSums<Float>;

    /// For the sums of groups of lights, before any light has arrived
    static Sums no_light(const Lights &lights) {
        return GroupLight<Float, Spectrum>::none_yet(lights.groups().count());
    }

    /// Into the layers of the film
    void write_layers(const Sums &sums, const Spectrum *weight,
                      const RayDifferential3f &ray, Float *aovs, Mask active) const {
        if (sums.size() > 0)
            manylights::write_layers<Float, Spectrum>(
                sums, weight, ray.wavelengths, aovs ? aovs + m_channels.groups : aovs,
                active);
    }

    /// Write the channels of the surfaces in sight; null: the caller has none
    void write_aovs(const Scene *scene, const RayDifferential3f &ray, Float *channels,
                    bool hide_emitters, Mask active) const {
        if (m_aovs.empty() || !channels)
            return;
        FirstHit<Float, Spectrum>(scene, m_shape_numbers, hide_emitters, m_lamps.get())
            .write(m_aovs, ray, channels + m_channels.aovs, active);
    }

    /// "name = value" lines of what has an effect
    std::string describe_parameters() const {
        std::string aovs = m_aovs.empty() ? "" : ",\naovs = " + to_string(m_aovs);
        return manylights::to_string(m_params) + aovs;
    }

    /// Media that camera rays pass, if they begin in `medium`
    virtual MediaKinds media(const Lights &, const Scene *, const Medium *) const {
        return {};
    }
    /// Do camera rays show emitters that they hit first?
    virtual bool shows_emitters() const { return !m_hide_emitters; }

    SamplingParameters m_params;
    std::vector<Aov> m_aovs;
    Cache m_cache;
    FilmChannels m_channels;
    /// Of the rendering, those that it samples, too; null if there are none
    std::shared_ptr<const Lamps> m_lamps;

private:
    using Renderer = std::conditional_t<dr::is_jit_v<Float>,
                                        Wavefronts<Float, Spectrum, LightIntegrator>,
                                        OrderedBlocks<Float, Spectrum, LightIntegrator>>;
    static constexpr uint32_t kOnePass = (uint32_t) -1; // Mitsuba's default

    /// Before a function is recorded or replayed
    void prepare_recording() const {
        std::unique_lock<std::recursive_mutex> lock(m_mutex, std::try_to_lock);
        if (!lock)
            throw std::runtime_error("manylights: dr.freeze looks at an integrator that "
                                     "renders in another thread.");
        TraversalUnlock unlock;
        Hash facts;
        facts.mix(m_cache.prepare_recording());
        facts.mix(m_learning.written());
        for (uint32_t number : m_plan.numbers())
            facts.mix(number);
        m_views.prepare(m_cache, film_size<Film>, facts);
        m_facts.set(facts.value);
    }

    void prepare_channels(const Scene *scene, const Film *film) const {
        if (has_flag(film->flags(), mitsuba::FilmFlags::Special) && !aov_names().empty())
            throw std::runtime_error(
                "The film \"" + std::string(film->class_name()) +
                "\" has bands of its own and takes no further channels: give \"counts\" "
                "and \"aovs\" to an integrator with an \"hdrfilm\".");
        for (const Aov &aov : m_aovs)
            if (aov.type == AovType::ShapeIndex)
                m_shape_numbers.prepare(scene);
    }

    /// One integrator has one rendering at a time: others that overlap wait for it
    std::unique_lock<std::recursive_mutex> lock_rendering() {
        return std::unique_lock<std::recursive_mutex>(m_mutex);
    }

    /// Follow the plan that was written; none ends a job
    void set_plan() {
        HostView numbers(m_plan_numbers);
        bool had_plan = !m_plan.empty();
        m_plan        = PassPlan();
        m_plan = PassPlan::parse({ numbers.data(), numbers.data() + numbers.size() });
        if (!m_plan.empty() || !had_plan || m_learning.keeps())
            return;
        m_learning.forget();
        m_cache.forget_visibility();
    }

    TensorXf render_passes(const typename Cache::Rendering &rendering, Scene *scene,
                           Sensor *sensor, const UInt32 &seed, uint32_t spp, bool develop,
                           bool evaluate) {
        m_stop = false;
        m_render_timer.reset();
        Lights &lights   = rendering.lights();
        Film *film       = sensor->film();
        Sampler *sampler = sensor->sampler();
        auto size        = film_size(film);
        if (spp)
            sampler->set_sample_count(spp);
        spp = sampler->sample_count();

        SamplerKind kind(sampler);
        bool job        = !m_plan.empty();
        uint64_t pixels = (uint64_t) size.x() * size.y();
        PassPlan plan = job ? m_plan : m_learning.plan(lights, scene, kind, spp, pixels);
        plan.check(spp);
        size_t channels = film->prepare(aov_names());
        log_start(size, spp, plan.size());
        typename Learning::Session session(m_learning);
        m_learning.start(lights, scene, sensor, plan, (double) pixels * spp, job);
        if (!is_recorded<Float>())
            m_views.remember(scene, sensor, m_cache);
        bool shows_lamps =
            shows_emitters() && !has_flag(film->flags(), mitsuba::FilmFlags::Special);
        LampPasses<Float, Spectrum> lamps(
            m_lamps, m_views, rendering, scene, sensor, shows_lamps,
            media(lights, scene, sensor->medium()), m_channels);
        Renderer renderer(*this, scene, sensor, channels, m_block_size);
        for (size_t i = 0; i < plan.size() && !should_stop(); ++i) {
            m_learning.start_pass(plan[i]);
            Pass pass(plan[i], seed, spp, job, sampler);
            renderer.render(pass);
            if (!should_stop())
                lamps.render(pass);
            m_learning.end_pass(plan[i], film, m_channels.groups);
        }
        if constexpr (dr::is_jit_v<Float>)
            Log(mitsuba::Info, "Computation graph recorded and compiled. (took %s)",
                mitsuba::util::time_string((float) m_render_timer.value(), true));
        return finish(film, develop, evaluate);
    }

    void log_start(const mitsuba::Vector<uint32_t, 2> &size, uint32_t spp,
                   size_t passes) const {
        Log(mitsuba::Info, "Starting render job (%s)",
            describe_job(size, spp, passes, dr::is_jit_v<Float> ? 0 : pool_size() + 1));
        if (m_timeout > 0.f)
            Log(mitsuba::Info, "Timeout specified: %.2f seconds.", m_timeout);
    }

    TensorXf finish(Film *film, bool develop, bool evaluate) {
        TensorXf result;
        if (develop) {
            result = film->develop();
            dr::schedule(result);
        } else {
            film->schedule_storage();
        }
        if constexpr (dr::is_jit_v<Float>) {
            if (!evaluate)
                return result;
            dr::eval();
            dr::sync_thread();
        }
        if (!m_stop)
            Log(mitsuba::Info, "Rendering finished. (took %s)",
                mitsuba::util::time_string((float) m_render_timer.value(), true));
        return result;
    }

    static constexpr const char *ClassName = "LightIntegrator"; // for log messages

    mutable std::recursive_mutex m_mutex;
    bool m_rendering = false, m_differentiating = false;
    /// What users have written, four numbers for each pass, and what it says
    mitsuba::DynamicBuffer<UInt32> m_plan_numbers;
    PassPlan m_plan;
    Learning m_learning;
    ShapeNumbers<Float, Spectrum> m_shape_numbers;
    mutable LampViews<Float, Spectrum> m_views;
    ColorTables<Float, Spectrum> m_color_tables;
    mutable HostFacts<dr::uint32_array_t<dr::detached_t<Float>>> m_facts;
};

} // namespace manylights

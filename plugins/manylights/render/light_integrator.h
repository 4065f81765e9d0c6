#pragma once

/**
 * What the integrators have in common: parameters, the lights of the scene, and rendering in
 * passes between which their visibility is learnt (learning_passes.h).
 */

#include "learning_passes.h"
#include "manylights/choice/parameters.h"
#include "manylights/scene/light_cache.h"
#include "passes.h"
#include "training_pixels.h"
#include <drjit/morton.h>
#include <drjit/packet.h>
#include <mitsuba/core/progress.h>
#include <mitsuba/render/film.h>
#include <mitsuba/render/imageblock.h>
#include <mitsuba/render/integrator.h>
#include <mitsuba/render/sensor.h>
#include <mitsuba/render/spiral.h>

namespace manylights {

template <typename Float, typename Spectrum,
          template <typename, typename> typename BaseIntegrator>
class LightIntegrator : public BaseIntegrator<Float, Spectrum> {
public:
    MI_IMPORT_BASE(BaseIntegrator, m_block_size, m_samples_per_pass, m_stop,
                   m_render_timer, should_stop, render_sample)
    MI_IMPORT_TYPES(Scene, Sensor, Sampler, Film, ImageBlock)
    using Cache  = LightCache<Float, Spectrum>;
    using Lights = typename Cache::Lights;
    using Pass   = manylights::Pass<Float, Spectrum>;
    using Learning = LearningPasses<Float, Spectrum>;

    LightIntegrator(const mitsuba::Properties &props, const SamplingParameters &params)
        : Base(props), m_params(params),
          m_cache(params.splits_nodes(), params.bsdf_samples > 0), m_learning(m_params) {}

    TensorXf render(Scene *scene, Sensor *sensor, UInt32 seed, uint32_t spp, bool develop,
                    bool evaluate) override {
        // Mitsuba's threads do, the main thread does not: bits would depend on who renders what
        dr::scoped_flush_denormals flush(true);
        auto lock = lock_learning();
        typename Cache::Rendering guard(m_cache, scene);
        if (m_rendering || m_differentiating || m_samples_per_pass != kOnePass ||
            has_entry_for_each_sample(sensor))
            return Base::render(scene, sensor, seed, spp, develop, evaluate);
        Flag rendering(m_rendering);
        return render_passes(guard.lights(), scene, sensor, seed, spp, develop, evaluate);
    }

    TensorXf render_forward(Scene *scene, void *params, Sensor *sensor, UInt32 seed,
                            uint32_t spp) override {
        auto lock = lock_learning();
        Flag guard(m_differentiating);
        return Base::render_forward(scene, params, sensor, seed, spp);
    }

    void render_backward(Scene *scene, void *params, const TensorXf &grad_in,
                         Sensor *sensor, UInt32 seed, uint32_t spp) override {
        auto lock = lock_learning();
        Flag guard(m_differentiating);
        Base::render_backward(scene, params, grad_in, sensor, seed, spp);
    }

    std::vector<std::string> aov_names() const override {
        return count_channels(m_params);
    }

    void traverse(mitsuba::TraversalCallback *cb) override {
        Base::traverse(cb);
        m_cache.traverse(cb);
        cb->put("plan", m_plan_numbers, mitsuba::ParamFlags::NonDifferentiable);
        m_learning.traverse(cb);
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
    SamplingParameters m_params;
    Cache m_cache;

private:
    static constexpr uint32_t kOnePass = (uint32_t) -1; // Mitsuba's default

    /// One integrator learns from one rendering at a time: others that overlap wait for it
    std::unique_lock<std::recursive_mutex> lock_learning() {
        std::unique_lock<std::recursive_mutex> lock(m_mutex, std::defer_lock);
        if (m_params.learn_visibility != LearnVisibility::No)
            lock.lock();
        return lock;
    }

    /// True for a while
    struct Flag {
        bool &flag;
        explicit Flag(bool &flag) : flag(flag) { flag = true; }
        ~Flag() { flag = false; }
        Flag(const Flag &) = delete;
    };

    /// Follow the plan that was written; none ends a job
    void set_plan() {
        HostView numbers(m_plan_numbers);
        bool had_plan = !m_plan.empty();
        m_plan        = PassPlan();
        m_plan        = PassPlan::parse({ numbers.data(), numbers.data() + numbers.size() });
        if (!m_plan.empty() || !had_plan || m_learning.keeps())
            return;
        m_learning.forget();
        m_cache.forget_visibility();
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

    TensorXf render_passes(Lights &lights, Scene *scene, Sensor *sensor,
                           const UInt32 &seed, uint32_t spp, bool develop,
                           bool evaluate) {
        m_stop = false;
        m_render_timer.reset();
        Film *film       = sensor->film();
        Sampler *sampler = sensor->sampler();
        auto size        = film_size(film);
        if (spp)
            sampler->set_sample_count(spp);
        spp = sampler->sample_count();

        SamplerKind kind(sampler);
        bool job        = !m_plan.empty();
        uint64_t pixels = (uint64_t) size.x() * size.y();
        PassPlan plan   = job ? m_plan : m_learning.plan(lights, kind, spp, pixels);
        plan.check(spp);
        size_t channels = film->prepare(aov_names());
        Log(mitsuba::Info, "Starting render job (%ux%u, %u sample%s%s)", size.x(),
            size.y(), spp, spp == 1 ? "" : "s",
            plan.size() > 1 ? tfm::format(", %u passes", plan.size()) : "");

        typename Learning::Session session(m_learning);
        m_learning.start(lights, scene, sensor, plan, (double) pixels * spp, job);
        for (size_t i = 0; i < plan.size() && !should_stop(); ++i) {
            m_learning.start_pass(plan[i]);
            Pass pass(plan[i], seed, spp, job, sampler);
            bool last = i + 1 == plan.size();
            if constexpr (dr::is_jit_v<Float>)
                render_wavefront(scene, sensor, channels, pass, last);
            else
                render_blocks(scene, sensor, channels, pass, spp);
            m_learning.end_pass(plan[i]);
        }
        return finish(film, develop, evaluate);
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

    // ------------------------------------------------------------------------ Scalar variants

    /// Side of the blocks that threads render: all of them get some
    uint32_t block_side(const mitsuba::Vector<uint32_t, 2> &size) const {
        uint32_t side = m_block_size > 0 ? m_block_size : MI_BLOCK_SIZE;
        auto count    = [&] { return dr::prod((size + (side - 1)) / side); };
        while (m_block_size == 0 && side > 1 && count() <= pool_size())
            side /= 2;
        return side;
    }

    void render_blocks(Scene *scene, Sensor *sensor, size_t channels, const Pass &pass,
                       uint32_t spp) {
        Film *film = sensor->film();
        SampleCount<Float, Spectrum> guard(sensor->sampler());
        sensor->sampler()->set_sample_count(pass.sampler_count);
        if (pass.sampler.indexed)
            set_first_sample<Float, Spectrum>(sensor->sampler(), pass.first);
        auto size     = film_size(film);
        uint32_t side = block_side(size);
        mitsuba::Spiral spiral(size, film->crop_offset(), side);
        std::mutex mutex;
        mitsuba::ref<mitsuba::ProgressReporter> progress = progress_reporter();
        uint32_t count = spiral.block_count(), done = 0,
                 grain = std::max(count / (4 * ((uint32_t) pool_size() + 1)), 1u);
        dr::parallel_for(
            dr::blocked_range<uint32_t>(0, count, grain), [&](const auto &range) {
                mitsuba::ref<Sampler> sampler  = sensor->sampler()->fork();
                mitsuba::ref<ImageBlock> block = film->create_block(
                    ScalarVector2u(side), /* normalize = */ false, /* border = */ true);
                std::unique_ptr<Float[]> aovs(new Float[channels]);
                for (uint32_t i = range.begin(); i != range.end() && !should_stop();
                     ++i) {
                    auto [offset, extent, id] = spiral.next_block();
                    if (film->sample_border())
                        offset -= film->rfilter()->border_size();
                    block->set_size(extent);
                    block->set_offset(offset);
                    render_pixels(scene, sensor, sampler, block, aovs.get(), pass, spp,
                                  side);
                    film->put_block(block);
                    std::lock_guard<std::mutex> lock(mutex);
                    if (++done; progress)
                        progress->update(((float) pass.plan.first +
                                          (float) pass.plan.count * done / (float) count) /
                                         (float) spp);
                }
            });
    }

    static mitsuba::ref<mitsuba::ProgressReporter> progress_reporter() {
        auto *logger = mitsuba::logger();
        return logger && mitsuba::Info >= logger->log_level()
                   ? new mitsuba::ProgressReporter("Rendering")
                   : nullptr;
    }

    /// Seeds belong to pixels: they do not depend on the size of blocks
    void render_pixels(const Scene *scene, const Sensor *sensor, Sampler *sampler,
                       ImageBlock *block, Float *aovs, const Pass &pass, uint32_t spp,
                       uint32_t side) const {
        const Film *film = sensor->film();
        auto size        = film_size(film);
        TrainingPixels<UInt32> training(size.x(), size.y(), pass.plan_seed);
        block->clear();
        for (uint32_t i = 0; i < side * side && !should_stop(); ++i) {
            auto at = dr::morton_decode<mitsuba::Point<uint32_t, 2>>(i);
            if (dr::any(at >= block->size()))
                continue;
            Point2i place = Point2i(at) + block->offset(),
                    pixel = place - Point2i(film->crop_offset());
            if (film->sample_border())
                pixel += film->rfilter()->border_size();
            if (pass.plan.role != Role::All &&
                training.contains(pixel.x(), pixel.y()) != (pass.plan.role == Role::Train))
                continue;
            sampler->seed(pass.seed * dr::prod(size) + pixel.y() * size.x() + pixel.x());
            if (!pass.sampler.indexed)
                skip(sampler, pass);
            for (uint32_t j = 0; j < pass.plan.count && !should_stop(); ++j) {
                render_sample(scene, sensor, sampler, block, aovs, Vector2f(place),
                              dr::rsqrt((ScalarFloat) spp), true);
                sampler->advance();
            }
        }
    }

    // --------------------------------------------------------------------------- JIT variants

    void render_wavefront(Scene *scene, Sensor *sensor, size_t channels,
                          const Pass &pass, bool last) {
        Film *film       = sensor->film();
        Sampler *sampler = sensor->sampler();
        auto size        = film_size(film);
        TrainingPixels<UInt32> training(size.x(), size.y(), pass.plan_seed);
        bool trains    = pass.plan.role == Role::Train;
        uint32_t count = trains ? training.columns * training.rows : dr::prod(size);

        SampleCount<Float, Spectrum> guard(sampler);
        sampler->set_sample_count(pass.sampler_count);
        auto lanes = wavefront(pass, sampler->sample_count());

        // Passes differ in these numbers: opaque, so that they have one kernel
        UInt32 index    = dr::arange<UInt32>(lanes.size(count));
        auto [block, i] = divide(index, lanes.block);
        auto [local, j] = divide(i, lanes.samples);
        UInt32 number   = dr::fmadd(block, dr::opaque<UInt32>(lanes.pixels), local);
        Mask active     = local < dr::opaque<UInt32>(lanes.pixels) && number < count &&
                      j >= dr::opaque<UInt32>(pass.first) &&
                      j < dr::opaque<UInt32>(pass.first + pass.plan.count);
        UInt32 x, y;
        std::tie(y, x) = divide(number, trains ? training.columns : size.x());
        if (trains) {
            std::tie(x, y) = training.in_block(x, y);
            active &= x < size.x() && y < size.y();
        } else if (pass.plan.role == Role::Rest) {
            active &= !training.contains(x, y);
        }
        UInt32 pixel = dr::fmadd(y, size.x(), x);

        seed(sampler, pass, lanes, pixel, number, j, lanes.size(count), dr::prod(size));

        // One for each pass: sums do not depend on which thread got which part
        mitsuba::ref<ImageBlock> image = film->create_block();
        image->set_offset(film->crop_offset());
        std::unique_ptr<Float[]> aovs(new Float[channels]);
        Vector2i position(Vector2u(x, y));
        if (film->sample_border())
            position -= film->rfilter()->border_size();
        render_sample(scene, sensor, sampler, image, aovs.get(),
                      Vector2f(position + film->crop_offset()),
                      dr::rsqrt((ScalarFloat) pass.spp), active);
        if (!last) // the last pass waits as any other rendering does
            dr::eval(image->tensor());
        film->put_block(image);
    }

    /// Each pixel gets the numbers that belong to it, whatever the lanes
    static void seed(Sampler *sampler, const Pass &pass, const Wavefront &lanes,
                     const UInt32 &pixel, const UInt32 &number, const UInt32 &sample,
                     uint32_t size, uint32_t pixels) {
        if (pass.sampler.indexed) {
            set_first_sample(sampler, UInt32(sample + dr::opaque<UInt32>(pass.first)));
            sampler->set_samples_per_wavefront(1);
            UInt32 first_key = pass.seed * pixels;
            dr::make_opaque(first_key);
            sampler->seed(first_key + pixel, size);
            return;
        }
        sampler->set_samples_per_wavefront(lanes.samples);
        UInt32 seed = pass.seed;
        // A pattern depends on the number of a pixel's first lane: to be that of all samples
        if (pass.sampler.pattern &&
            (lanes.samples < pass.sampler_count || pass.plan.role == Role::Train))
            seed += pixel * pass.sampler_count - number * lanes.samples;
        sampler->seed(seed, size);
    }

    /// Quotient and remainder: exact, and faster than a division of integers
    static std::pair<UInt32, UInt32> divide(const UInt32 &x, uint32_t divisor) {
        using Double    = dr::float64_array_t<Float>;
        UInt32 quotient = UInt32((Double(x) + .5) * dr::opaque<Double>(1. / divisor));
        return { quotient, dr::fnmadd(quotient, dr::opaque<UInt32>(divisor), x) };
    }

    static constexpr const char *ClassName = "LightIntegrator"; // for log messages

    std::recursive_mutex m_mutex;
    bool m_rendering = false, m_differentiating = false;
    /// What users have written, four numbers for each pass, and what it says
    mitsuba::DynamicBuffer<UInt32> m_plan_numbers;
    PassPlan m_plan;
    Learning m_learning;
};

} // namespace manylights

#pragma once

/**
 * What the integrators have in common: parameters, the lights of the scene, and rendering in
 * passes between which their visibility is learnt (learning_passes.h).
 */

#include "learning_passes.h"
#include "manylights/choice/parameters.h"
#include "manylights/scene/light_cache.h"
#include "passes.h"
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

    LightIntegrator(const mitsuba::Properties &props, const SamplingParameters &params)
        : Base(props), m_params(params),
          m_cache(params.splits_nodes(), params.bsdf_samples > 0) {}

    TensorXf render(Scene *scene, Sensor *sensor, UInt32 seed, uint32_t spp, bool develop,
                    bool evaluate) override {
        // Mitsuba's threads do, the main thread does not: bits would depend on who renders what
        dr::scoped_flush_denormals flush(true);
        auto lock = lock_learning();
        typename Cache::Rendering guard(m_cache, scene);
        bool may_learn =
            !m_learning && !m_differentiating && m_samples_per_pass == kOnePass;
        LearningPasses<Float, Spectrum> learning(guard.lights(), m_params, m_learning);
        if (may_learn)
            learning.start(scene, sensor, spp);
        if (learning.wanted())
            return render_passes(learning, scene, sensor, seed, develop, evaluate);
        return Base::render(scene, sensor, seed, spp, develop, evaluate);
    }

    TensorXf render_forward(Scene *scene, void *params, Sensor *sensor, UInt32 seed,
                            uint32_t spp) override {
        auto lock = lock_learning();
        Differentiating guard(m_differentiating);
        return Base::render_forward(scene, params, sensor, seed, spp);
    }

    void render_backward(Scene *scene, void *params, const TensorXf &grad_in,
                         Sensor *sensor, UInt32 seed, uint32_t spp) override {
        auto lock = lock_learning();
        Differentiating guard(m_differentiating);
        Base::render_backward(scene, params, grad_in, sensor, seed, spp);
    }

    std::vector<std::string> aov_names() const override {
        return count_channels(m_params);
    }

    void traverse(mitsuba::TraversalCallback *cb) override {
        Base::traverse(cb);
        m_cache.traverse(cb);
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

    /// Gradients are computed from one recording, without passes
    struct Differentiating {
        bool &flag;
        explicit Differentiating(bool &flag) : flag(flag) { flag = true; }
        ~Differentiating() { flag = false; }
    };

    /// Mitsuba's passes are all of one size, those of \ref LearningPasses are not
    TensorXf render_passes(LearningPasses<Float, Spectrum> &learning, Scene *scene,
                           Sensor *sensor, const UInt32 &seed, bool develop,
                           bool evaluate) {
        m_stop = false;
        m_render_timer.reset();
        Film *film       = sensor->film();
        Sampler *sampler = sensor->sampler();
        auto size        = film_size(film);
        uint32_t spp     = sampler->sample_count();
        Log(mitsuba::Info, "Starting render job (%ux%u, %u samples, learning visibility)",
            size.x(), size.y(), spp);

        size_t channels = film->prepare(aov_names());
        uint32_t done   = 0;
        for (uint32_t number = 0; done < spp && !should_stop(); ++number) {
            uint32_t samples = learning.start_pass(number, spp - done);
            Pass pass(seed, number, done, samples, sampler);
            if constexpr (dr::is_jit_v<Float>)
                render_wavefront(scene, sensor, channels, pass);
            else
                render_blocks(scene, sensor, channels, pass, spp);
            done += samples;
        }
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
        Film *film    = sensor->film();
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
                        progress->update(((float) pass.first +
                                          (float) pass.samples * done / (float) count) /
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
        block->clear();
        for (uint32_t i = 0; i < side * side && !should_stop(); ++i) {
            auto at = dr::morton_decode<mitsuba::Point<uint32_t, 2>>(i);
            if (dr::any(at >= block->size()))
                continue;
            Point2i place = Point2i(at) + block->offset(),
                    pixel = place - Point2i(film->crop_offset());
            if (film->sample_border())
                pixel += film->rfilter()->border_size();
            sampler->seed(pass.seed * dr::prod(size) + pixel.y() * size.x() + pixel.x());
            skip(sampler, pass);
            for (uint32_t j = 0; j < pass.samples && !should_stop(); ++j) {
                render_sample(scene, sensor, sampler, block, aovs, Vector2f(place),
                              dr::rsqrt((ScalarFloat) spp), true);
                sampler->advance();
            }
        }
    }

    // --------------------------------------------------------------------------- JIT variants

    void render_wavefront(Scene *scene, Sensor *sensor, size_t channels,
                          const Pass &pass) {
        Film *film       = sensor->film();
        Sampler *sampler = sensor->sampler();
        auto size        = film_size(film);
        uint32_t spp     = sampler->sample_count();
        auto lanes       = wavefront(pass, spp);

        // Passes differ in these numbers: opaque, so that they have one kernel
        UInt32 index    = dr::arange<UInt32>(lanes.size(dr::prod(size)));
        auto [block, i] = divide(index, lanes.block);
        auto [local, j] = divide(i, lanes.samples);
        UInt32 pixel    = dr::fmadd(block, dr::opaque<UInt32>(lanes.pixels), local);
        uint32_t masked = pass.sampler.independent ? 0 : pass.first;
        Mask active     = local < dr::opaque<UInt32>(lanes.pixels) &&
                          pixel < dr::prod(size) && j >= dr::opaque<UInt32>(masked);

        SampleCount<Float, Spectrum> guard(sampler);
        if (pass.sampler.independent)
            sampler->set_sample_count(lanes.samples);
        sampler->set_samples_per_wavefront(lanes.samples);
        // A pattern depends on the number of a pixel's first lane: to be that of all samples
        UInt32 seed = pass.seed;
        if (pass.sampler.pattern && lanes.samples < spp)
            seed += pixel * (spp - lanes.samples);
        sampler->seed(seed, lanes.size(dr::prod(size)));

        // One for each pass: sums do not depend on which thread got which part
        mitsuba::ref<ImageBlock> image = film->create_block();
        image->set_offset(film->crop_offset());
        std::unique_ptr<Float[]> aovs(new Float[channels]);
        render_sample(scene, sensor, sampler, image, aovs.get(),
                      position(film, size, pixel), dr::rsqrt((ScalarFloat) spp), active);
        if (pass.first + pass.samples <
            spp) // the last pass waits as any other rendering does
            dr::eval(image->tensor());
        film->put_block(image);
    }

    /// Quotient and remainder: exact, and faster than a division of integers
    static std::pair<UInt32, UInt32> divide(const UInt32 &x, uint32_t divisor) {
        using Double    = dr::float64_array_t<Float>;
        UInt32 quotient = UInt32((Double(x) + .5) * dr::opaque<Double>(1. / divisor));
        return { quotient, dr::fnmadd(quotient, dr::opaque<UInt32>(divisor), x) };
    }

    /// Of a pixel on the film
    static Vector2f position(const Film *film, const mitsuba::Vector<uint32_t, 2> &size,
                             const UInt32 &pixel) {
        UInt32 y = pixel / size.x();
        Vector2i result(Vector2u(dr::fnmadd(y, size.x(), pixel), y));
        if (film->sample_border())
            result -= film->rfilter()->border_size();
        return Vector2f(result + film->crop_offset());
    }

    static constexpr const char *ClassName = "LightIntegrator"; // for log messages

    std::recursive_mutex m_mutex;
    bool m_learning = false, m_differentiating = false;
};

} // namespace manylights

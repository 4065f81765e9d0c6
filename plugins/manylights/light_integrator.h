#pragma once

/**
 * What the integrators have in common: parameters, the lights of the scene, and rendering in
 * passes between which their visibility is learnt (visibility.h).
 */

#include "light_cache.h"
#include "parameters.h"
#include <condition_variable>
#include <drjit/packet.h>
#include <mitsuba/render/film.h>
#include <mitsuba/render/imageblock.h>
#include <mitsuba/render/integrator.h>
#include <mitsuba/render/sensor.h>

namespace manylights {

template <typename Float, typename Spectrum,
          template <typename, typename> typename BaseIntegrator>
class LightIntegrator : public BaseIntegrator<Float, Spectrum> {
public:
    MI_IMPORT_BASE(BaseIntegrator, m_samples_per_pass, m_stop, m_render_timer,
                   should_stop, render_sample)
    MI_IMPORT_TYPES(Scene, Sensor, Sampler, Film, ImageBlock)
    using Cache  = LightCache<Float, Spectrum>;
    using Lights = typename Cache::Lights;

    LightIntegrator(const mitsuba::Properties &props, const SamplingParameters &params)
        : Base(props), m_params(params),
          m_cache(params.splits_nodes(), params.bsdf_samples > 0) {}

    TensorXf render(Scene *scene, Sensor *sensor, UInt32 seed, uint32_t spp, bool develop,
                    bool evaluate) override {
        // Mitsuba's threads do, the main thread does not: bits would depend on who renders what
        dr::scoped_flush_denormals flush(true);
        auto lock = lock_learning();
        typename Cache::Rendering guard(m_cache, scene);
        Learning learning(*this, scene, sensor, spp, guard.lights());
        if constexpr (dr::is_jit_v<Float>)
            if (m_learning == &learning)
                return render_passes(scene, sensor, seed, develop, evaluate);
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

    /// Scalar variants: blocks come in the order of their passes, see \ref Learning
    void render_block(const Scene *scene, const Sensor *sensor, Sampler *sampler,
                      ImageBlock *block, Float *aovs, uint32_t sample_count, UInt32 seed,
                      uint32_t block_id, uint32_t block_size) const override {
        auto render = [&] {
            Base::render_block(scene, sensor, sampler, block, aovs, sample_count, seed,
                               block_id, block_size);
        };
        if (!m_learning)
            return render();
        typename Learning::Block current(*m_learning, block_id, block_size);
        // By number, the blocks of later passes would have the seeds of other renderings
        seed     = pass_seed(seed, current.pass);
        block_id = current.number;
        render();
        current.put(block);
    }

private:
    /// One integrator learns from one rendering at a time: others that overlap wait for it
    std::unique_lock<std::recursive_mutex> lock_learning() {
        std::unique_lock<std::recursive_mutex> lock(m_mutex, std::defer_lock);
        if (m_params.learn_visibility != LearnVisibility::No)
            lock.lock();
        return lock;
    }

    /// The first pass has the seed of the rendering
    static UInt32 pass_seed(const UInt32 &seed, uint32_t pass) {
        return pass ? mitsuba::sample_tea_32(seed, UInt32(pass)).first : seed;
    }

    /// Gradients are computed from one recording, without passes
    struct Differentiating {
        bool &flag;
        explicit Differentiating(bool &flag) : flag(flag) { flag = true; }
        ~Differentiating() { flag = false; }
    };

    static mitsuba::Vector<uint32_t, 2> film_size(const Film *film) {
        auto size = film->crop_size();
        if (film->sample_border())
            size += 2 * film->rfilter()->border_size();
        return size;
    }

    /**
     * The passes of a rendering. Visibility is learnt from the shadow rays of the first one, at
     * most a sixteenth of the samples, and of a second one if the first promises much. JIT variants
     * render all others in one pass, since each is recorded anew, which takes 3 to 17 ms;
     * scalar ones in passes of the same size. Relative variance times time of a second
     * training pass and of none, in llvm_ad_rgb with 64 samples for each of 256x144 pixels: .91
     * and .98 in a house of 108 rooms with 10,000 and 1,000 lights, 1.04 to 1.12 where less is
     * hidden. More teach little: trained for 2, 4, 8 and all of 16 passes of the same size, that
     * house with 1,000 lights had .194, .189, .187 and .187 of relative variance at 603, 628, 664
     * and 742 ns a sample.
     */
    class Learning {
    public:
        Learning(LightIntegrator &integrator, const Scene *scene, Sensor *sensor,
                 uint32_t spp, Lights &lights)
            : m_integrator(integrator), m_lights(lights), m_film(sensor->film()),
              m_size(film_size(m_film)) {
            const SamplingParameters &params = integrator.m_params;
            if (params.learn_visibility == LearnVisibility::No || integrator.m_learning ||
                integrator.m_differentiating ||
                integrator.m_samples_per_pass != kOnePass ||
                params.considers_all(lights.tree().light_count))
                return;
            Sampler *sampler = sensor->sampler();
            if (spp)
                sampler->set_sample_count(spp);
            spp          = sampler->sample_count();
            double total = (double) dr::prod(m_size) * spp;
            m_training   = training_samples(spp, dr::prod(m_size));
            if (spp < kLeastSamples || total < kLeastTotal || total > kMostTotal)
                return;
            lights.start_learning(scene, cell_size(scene, sensor), total, keeps());
            m_passes                      = spp / m_training;
            integrator.m_samples_per_pass = m_training;
            integrator.m_learning         = this;
        }
        ~Learning() {
            if (m_integrator.m_learning != this)
                return;
            m_integrator.m_learning         = nullptr;
            m_integrator.m_samples_per_pass = kOnePass;
            m_lights.stop_learning(keeps());
        }

        /// Returns the samples per pixel of a pass, of `left` that have not been rendered
        uint32_t start_pass(uint32_t pass, uint32_t left) {
            if (pass > 0 && m_trains)
                m_trains = m_lights.learn(/* go_on = */ pass < kTraining);
            m_started = pass + 1;
            return m_trains ? std::min(m_training, left) : left;
        }

        /// A block waits for those of the pass before, and starts its pass if it is the first.
        /// All of these have been handed out by then, so they are done or being rendered.
        struct Block {
            Learning &learning;
            /// Its pass, and its number therein
            uint32_t pass, number;

            Block(Learning &l, uint32_t id, uint32_t size) : learning(l) {
                uint32_t blocks = dr::prod((l.m_size + (size - 1)) / size);
                pass            = l.m_passes - 1 - id / blocks;
                number          = id % blocks;
                std::unique_lock<std::mutex> lock(l.m_mutex);
                l.m_block_done.wait(lock,
                                    [&] { return l.m_blocks_done >= pass * blocks; });
                if (pass == l.m_started)
                    l.start_pass(pass, l.m_training);
            }
            /// Mitsuba would put it into the film after the next pass may have begun: sums
            /// would depend on which is first. All that is left to it is zeros.
            void put(ImageBlock *block) {
                learning.m_film->put_block(block);
                block->clear();
            }
            ~Block() {
                std::lock_guard<std::mutex> lock(learning.m_mutex);
                ++learning.m_blocks_done;
                learning.m_block_done.notify_all();
            }
        };

    private:
        static constexpr uint32_t kTraining = 2,
                                  kOnePass  = (uint32_t) -1; // Mitsuba's default
        /// The image has the noise of these samples, too. Error times time without learning, over
        /// that with it, if 1/16, 1/32 and 1/64 of 64 samples train: 1.96, 2.05, 1.98 with 256 x
        /// 144 pixels in llvm_ad_rgb (geometric mean of eight scenes); 1.83, 2.04, 2.16 with 1280 x
        /// 720 in cuda_ad_rgb (six scenes; in a house with 1,000 lights 6.0, 7.9, 9.3).
        static constexpr uint32_t kTrainingTotal = 1 << 16;
        /// Of three, the first would be a large part, and it is the slowest
        static constexpr uint32_t kLeastSamples = 4;
        /// A wavefront has less than 2^32 lanes, and some may be left over
        static constexpr double kMostTotal =
            dr::is_jit_v<Float> ? 0x1p31 : dr::Infinity<double>;
        /// With fewer samples, recording one more pass takes longer than it may gain. On an H100 the
        /// mean of five scenes, as above, was 1.39 at 1.5e7 samples, 1.15 at 3.7e6 and .91 at 9e5
        static constexpr double kLeastTotal =
            dr::is_cuda_v<Float> ? 0x1p23 : (dr::is_llvm_v<Float> ? 0x1p19 : 0);

        bool keeps() const {
            return m_integrator.m_params.learn_visibility == LearnVisibility::Keep;
        }

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

        LightIntegrator &m_integrator;
        Lights &m_lights;
        Film *m_film;
        mitsuba::Vector<uint32_t, 2> m_size;
        /// Samples per pixel of a training pass, and how many of its size there are
        uint32_t m_training, m_passes;
        bool m_trains      = true;
        uint32_t m_started = 0, m_blocks_done = 0;
        std::mutex m_mutex;
        std::condition_variable m_block_done;
    };

    /// JIT variants: Mitsuba's passes are all of one size, those of \ref Learning are not
    TensorXf render_passes(Scene *scene, Sensor *sensor, UInt32 seed, bool develop,
                           bool evaluate) {
        m_stop = false;
        m_render_timer.reset();
        Film *film   = sensor->film();
        auto size    = film_size(film);
        uint32_t spp = sensor->sampler()->sample_count();
        Log(mitsuba::Info, "Starting render job (%ux%u, %u samples, learning visibility)",
            size.x(), size.y(), spp);

        std::unique_ptr<Float[]> aovs(new Float[film->prepare(aov_names())]);
        uint32_t done = 0;
        for (uint32_t pass = 0; done < spp && !should_stop(); ++pass) {
            uint32_t samples = m_learning->start_pass(pass, spp - done);
            render_pass(scene, sensor, aovs.get(), pass_seed(seed, pass), done, samples);
            done += samples;
        }
        TensorXf result;
        if (develop) {
            result = film->develop();
            dr::schedule(result);
        } else {
            film->schedule_storage();
        }
        if (!evaluate)
            return result;
        dr::eval();
        dr::sync_thread();
        if (!m_stop)
            Log(mitsuba::Info, "Rendering finished. (took %s)",
                mitsuba::util::time_string((float) m_render_timer.value(), true));
        return result;
    }

    /// How samples lie in a wavefront: blocks of lanes hold whole pixels, and some lanes may be
    /// left over
    struct Wavefront {
        /// Lanes of a block, pixels therein, and lanes of each pixel
        uint32_t block, pixels, samples;

        uint32_t size(uint32_t pixel_count) const {
            return (pixel_count + pixels - 1) / pixels * block;
        }
    };

    /**
     * Of the independent sampler, any number of samples. No pixel is split between threads, or
     * warps that are not full, whose sums would depend on which of them came first, unless more
     * than an eighth of the lanes would be left over. Of stratified samplers, a number that
     * divides the whole, or else all samples.
     */
    static Wavefront wavefront(bool stratified, uint32_t first, uint32_t samples,
                               uint32_t spp) {
        uint32_t block = dr::is_cuda_v<Float> ? 32 : jit_llvm_block_size();
        block          = std::max(block, mitsuba::math::round_to_power_of_two(samples));
        if (!stratified && block % samples <= block / 8)
            return { block, block / samples, samples };
        bool divides   = first % samples == 0 && spp % samples == 0;
        uint32_t lanes = stratified && !divides ? spp : samples;
        return { lanes, 1, lanes };
    }

    /// Render some of each pixel's samples, from number `first` on
    void render_pass(Scene *scene, Sensor *sensor, Float *aovs, const UInt32 &seed,
                     uint32_t first, uint32_t samples) {
        Film *film       = sensor->film();
        Sampler *sampler = sensor->sampler();
        auto size        = film_size(film);
        uint32_t spp     = sampler->sample_count();
        bool stratified  = sampler->class_name() != std::string("IndependentSampler");
        auto lanes       = wavefront(stratified, first, samples, spp);
        if (!stratified)
            sampler->set_sample_count(lanes.samples);
        sampler->set_samples_per_wavefront(lanes.samples);
        sampler->seed(seed, lanes.size(dr::prod(size)));
        // Those before have been rendered: skipped if the wavefront lacks them, else masked
        for (uint32_t i = 0; stratified && lanes.samples < spp && i < first; i += samples)
            sampler->advance();

        // Passes differ in these numbers: opaque, so that they have one kernel
        UInt32 index    = dr::arange<UInt32>(lanes.size(dr::prod(size)));
        auto [block, i] = divide(index, lanes.block);
        auto [local, j] = divide(i, lanes.samples);
        UInt32 pixel    = dr::fmadd(block, dr::opaque<UInt32>(lanes.pixels), local);
        Mask active     = local < dr::opaque<UInt32>(lanes.pixels) &&
                          pixel < dr::prod(size) &&
                          j >= dr::opaque<UInt32>(lanes.samples > samples ? first : 0);

        // One for each pass: sums do not depend on which thread got which part
        mitsuba::ref<ImageBlock> image = film->create_block();
        image->set_offset(film->crop_offset());
        render_sample(scene, sensor, sampler, image, aovs, position(film, size, pixel),
                      dr::rsqrt((ScalarFloat) spp), active);
        if (first + samples < spp) // the last pass waits as any other rendering does
            dr::eval(image->tensor());
        film->put_block(image);
        sampler->set_sample_count(spp);
        sampler->set_samples_per_wavefront(spp);
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
    Learning *m_learning   = nullptr;
    bool m_differentiating = false;
};

} // namespace manylights

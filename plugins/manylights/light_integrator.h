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
        : Base(props), m_params(params), m_cache(params.splits_nodes()) {}

    TensorXf render(Scene *scene, Sensor *sensor, UInt32 seed, uint32_t spp, bool develop,
                    bool evaluate) override {
        // Mitsuba's threads do, the main thread does not: bits would depend on who renders what
        dr::scoped_flush_denormals flush(true);
        auto lock = lock_learning();
        typename Cache::Rendering guard(m_cache, scene);
        Learning learning(*this, scene, sensor, spp, guard.lights());
        if constexpr (dr::is_jit_v<Float>)
            if (m_learning == &learning)
                return render_passes(scene, sensor, seed, develop);
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
     * The passes of a rendering. Visibility is learnt from the shadow rays of the first two,
     * after each of them. More learn little: trained for 2, 4, 8 and all of 16 passes, a house
     * of 108 rooms with 1,000 lights had .194, .189, .187 and .187 of relative variance, at
     * 603, 628, 664 and 742 ns a sample.
     */
    class Learning {
    public:
        Learning(LightIntegrator &integrator, const Scene *scene, Sensor *sensor,
                 uint32_t spp, Lights &lights)
            : m_integrator(integrator), m_lights(lights),
              m_size(film_size(sensor->film())) {
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
            if constexpr (dr::is_jit_v<Float>)
                m_passes = doubling_passes(spp, total);
            else
                m_passes = equal_passes(spp);
            if (m_passes.size() < 2)
                return;
            lights.start_learning(scene, cell_size(scene, sensor), total, keeps());
            integrator.m_samples_per_pass = m_passes[0];
            integrator.m_learning         = this;
        }
        ~Learning() {
            if (m_integrator.m_learning != this)
                return;
            m_integrator.m_learning         = nullptr;
            m_integrator.m_samples_per_pass = kOnePass;
            m_lights.stop_learning(keeps());
        }

        const std::vector<uint32_t> &passes() const { return m_passes; }

        void start_pass(uint32_t pass) {
            if (pass == 1 || pass == kTraining)
                m_lights.learn(/* go_on = */ pass < kTraining);
            m_started = pass + 1;
        }

        /// A block waits for those of the pass before, and starts its pass if it is the first.
        /// All of these have been handed out by then, so they are done or being rendered.
        struct Block {
            Learning &learning;
            /// Its pass, and its number therein
            uint32_t pass, number;

            Block(Learning &l, uint32_t id, uint32_t size) : learning(l) {
                uint32_t blocks = dr::prod((l.m_size + (size - 1)) / size);
                pass            = (uint32_t) l.m_passes.size() - 1 - id / blocks;
                number          = id % blocks;
                std::unique_lock<std::mutex> lock(l.m_mutex);
                l.m_block_done.wait(lock,
                                    [&] { return l.m_blocks_done >= pass * blocks; });
                if (pass == l.m_started)
                    l.start_pass(pass);
            }
            ~Block() {
                std::lock_guard<std::mutex> lock(learning.m_mutex);
                ++learning.m_blocks_done;
                learning.m_block_done.notify_all();
            }
        };

    private:
        static constexpr uint32_t kTraining = 2, kMostPasses = 16,
                                  kOnePass = (uint32_t) -1; // Mitsuba's default

        bool keeps() const {
            return m_integrator.m_params.learn_visibility == LearnVisibility::Keep;
        }

        /// Samples of each pass: 1, 1, 2, 4 and 8 sixteenths, or fewer passes where the first
        /// ones would be so small that recording them takes longer than rendering them
        static std::vector<uint32_t> doubling_passes(uint32_t spp, double total) {
            const double least = dr::is_cuda_v<Float> ? 1 << 20 : 1 << 15;
            std::vector<uint32_t> passes;
            if (total > 0x1p32) // Mitsuba itself splits what exceeds a wavefront
                return passes;
            uint32_t left = spp;
            while (passes.size() < 4 && left % 2 == 0 &&
                   total * (left / 2) / spp >= least) {
                left /= 2;
                passes.insert(passes.begin(), left);
            }
            passes.insert(passes.begin(), left);
            return passes;
        }

        /// 16 passes, or the next larger number that divides the samples
        static std::vector<uint32_t> equal_passes(uint32_t spp) {
            uint32_t count = std::min(spp, kMostPasses);
            while (spp % count)
                ++count;
            return std::vector<uint32_t>(count, spp / count);
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
        mitsuba::Vector<uint32_t, 2> m_size;
        /// Samples per pixel of each pass
        std::vector<uint32_t> m_passes;
        uint32_t m_started = 0, m_blocks_done = 0;
        std::mutex m_mutex;
        std::condition_variable m_block_done;
    };

    /// JIT variants: Mitsuba's passes are all of one size, these double. Each uses the samples
    /// of a stratified sampler that follow those of the passes before.
    TensorXf render_passes(Scene *scene, Sensor *sensor, UInt32 seed, bool develop) {
        m_stop = false;
        m_render_timer.reset();
        Film *film       = sensor->film();
        Sampler *sampler = sensor->sampler();
        auto size        = film_size(film);
        uint32_t spp     = sampler->sample_count();
        Log(mitsuba::Info, "Starting render job (%ux%u, %u samples, %u passes)", size.x(),
            size.y(), spp, m_learning->passes().size());

        std::unique_ptr<Float[]> aovs(new Float[film->prepare(aov_names())]);
        uint32_t pass = 0;
        for (uint32_t samples : m_learning->passes()) {
            if (should_stop())
                break;
            m_learning->start_pass(pass);
            sampler->set_samples_per_wavefront(samples);
            sampler->seed(pass_seed(seed, pass), dr::prod(size) * samples);
            if (pass > 0)
                sampler->advance();
            // One for each pass: sums do not depend on which thread got which part
            mitsuba::ref<ImageBlock> block = film->create_block();
            block->set_offset(film->crop_offset());
            render_sample(scene, sensor, sampler, block, aovs.get(),
                          pixels(film, size, samples), dr::rsqrt((ScalarFloat) spp));
            dr::eval(block->tensor());
            film->put_block(block);
            ++pass;
        }
        sampler->set_samples_per_wavefront(spp);
        TensorXf result;
        if (develop) {
            result = film->develop();
            dr::schedule(result);
        } else {
            film->schedule_storage();
        }
        dr::eval();
        dr::sync_thread();
        if (!m_stop)
            Log(mitsuba::Info, "Rendering finished. (took %s)",
                mitsuba::util::time_string((float) m_render_timer.value(), true));
        return result;
    }

    /// The pixel of each sample
    static Vector2f pixels(const Film *film, const mitsuba::Vector<uint32_t, 2> &size,
                           uint32_t samples) {
        UInt32 index = dr::arange<UInt32>(dr::prod(size) * samples);
        // Passes differ in this number: opaque, so that they have one kernel
        if ((samples & (samples - 1)) == 0)
            index >>= dr::opaque<UInt32>(dr::log2i(samples));
        else
            index /= dr::opaque<UInt32>(samples);
        UInt32 y = index / size.x();
        Vector2i result(Vector2u(dr::fnmadd(y, size.x(), index), y));
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

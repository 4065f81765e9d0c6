#pragma once

/**
 * A pass of JIT variants: parts of it, each a range of pixels with all their samples, are
 * evaluated one after the other and added to the film (film_sums.h). A part takes a bounded
 * amount of memory. How many there are depends on constants, so that bits do not depend on the
 * machine.
 */

#include "camera_sample.h"
#include "film_sums.h"
#include "passes.h"
#include <mitsuba/render/integrator.h>
#include <mitsuba/render/sensor.h>

namespace manylights {

template <typename Float, typename Spectrum, typename Integrator> class Wavefronts {
public:
    MI_IMPORT_TYPES(Scene, Sensor, Sampler, Film, ImageBlock, Medium)
    using Pass   = manylights::Pass<Float, Spectrum>;
    using Sums   = FilmSums<Float, Spectrum>;
    using Pixels = PixelSet<UInt32>;

    Wavefronts(const Integrator &integrator, const Scene *scene, Sensor *sensor,
               size_t channels, uint32_t)
        : m_integrator(integrator), m_scene(scene), m_sensor(sensor),
          m_film(sensor->film()), m_sampler(sensor->sampler()), m_size(film_size(m_film)),
          m_channels(channels) {}

    void render(const Pass &pass) {
        SampleCount<Float, Spectrum> guard(m_sampler);
        // No pixel has more samples at once than a part, if the sampler lets us choose
        uint32_t most = pass.sampler.divides() ? most_lanes(1) : pass.plan.count;
        for (uint32_t done = 0; done < pass.plan.count; done += most)
            render_samples(pass.piece(done, std::min(most, pass.plan.count - done)));
    }

private:
    void render_samples(const Pass &pass) {
        m_sampler->set_sample_count(pass.sampler_count);
        uint32_t samples = samples_per_pixel(pass);
        Pixels pixels(m_size.x(), m_size.y(), pass.plan.role, pass.plan_seed);
        uint64_t count = pixels.size(), most = most_lanes(samples),
                 parts = (count * samples + most - 1) / most;
        uint32_t part  = (uint32_t) ((count + parts - 1) / parts);
        for (uint32_t first = 0; first < count && !m_integrator.should_stop();
             first += part)
            render_part(pass, pixels, first, std::min(part, (uint32_t) count - first),
                        samples);
    }

    /// The samples of a part and their sums take at most so much memory
    static constexpr uint32_t kPartBytes = 1u << 30;

    uint32_t most_lanes(uint32_t samples) const {
        // Those of surfaces do not count: with them the image has the same parts
        size_t channels = m_channels - m_integrator.aov_count();
        uint32_t numbers =
            (uint32_t) channels + 2 + Sums::stored(m_film, channels) / samples;
        uint32_t wanted = kPartBytes / ((uint32_t) sizeof(ScalarFloat) * numbers);
        uint32_t result = 1;
        while (2 * result <= wanted)
            result *= 2;
        return result;
    }

    /// Of samplers that have any samples, those of the pass. Of others, all up to the last one
    /// of the pass, if their number divides the whole, or else all samples.
    uint32_t samples_per_pixel(const Pass &pass) const {
        if (pass.sampler.divides())
            return pass.plan.count;
        uint32_t total = m_sampler->sample_count(), result = pass.first + pass.plan.count;
        return total % result == 0 ? result : total;
    }

    void render_part(const Pass &pass, const Pixels &pixels, uint32_t first,
                     uint32_t count, uint32_t samples) {
        // Parts differ in these numbers: opaque, so that they have one kernel
        UInt32 lane         = dr::arange<UInt32>(count * samples);
        auto [number, j]    = divide(lane, samples);
        auto [x, y, active] = pixels.pixel(number + dr::opaque<UInt32>(first));
        if (samples > pass.plan.count)
            active &= j >= dr::opaque<UInt32>(pass.first) &&
                      j < dr::opaque<UInt32>(pass.first + pass.plan.count);
        seed(pass, first, number, dr::fmadd(y, m_size.x(), x), j, count * samples,
             samples);

        Vector2i pixel(Vector2u(x, y));
        if (m_film->sample_border())
            pixel -= m_film->rfilter()->border_size();
        pixel += m_film->crop_offset(); // may be negative
        typename Sums::Samples result{ first, count, samples, {}, {} };
        std::unique_ptr<Float[]> values(new Float[m_channels]);
        CameraSample<Float, Spectrum, Integrator> sample(m_integrator, m_scene, m_sensor,
                                                         m_sampler);
        result.offset = sample.render(Vector2f(pixel), dr::rsqrt((ScalarFloat) pass.spp),
                                      values.get(), active);
        bool differentiable = false;
        for (size_t i = 0; i < m_channels; ++i) {
            differentiable |= dr::grad_enabled(values[i]);
            result.channels.push_back(dr::select(active, values[i], 0.f));
        }
        if (differentiable)
            return put(result, pixel, values.get(), active);
        if (m_film->rfilter()->is_box_filter())
            result.offset = 0.f;
        // The memory of the part before is free only when its kernels have run
        dr::schedule(result.offset);
        for (Float &channel : result.channels)
            dr::schedule(channel);
        if (m_has_part)
            dr::sync_thread();
        dr::eval();
        m_has_part = true;
        Sums(m_film, m_size, pixels).add(result, rows(pass, pixels, first, count));
    }

    /// Those that numbers of a set of pixels are in
    std::pair<uint32_t, uint32_t> rows(const Pass &pass, const Pixels &pixels,
                                       uint32_t first, uint32_t count) const {
        uint32_t side = pass.plan.role == Role::All ? 1 : Pixels::kSide;
        return { pixels.row(first),
                 std::min(pixels.row(first + count - 1) + side, m_size.y()) };
    }

    /// Where gradients are wanted
    void put(const typename Sums::Samples &samples, const Vector2i &pixel,
             const Float *values, const Mask &active) const {
        mitsuba::ref<ImageBlock> block = m_film->create_block();
        block->set_offset(m_film->crop_offset());
        block->set_coalesce(block->coalesce() && samples.per_number >= 4);
        block->put(Vector2f(pixel) + samples.offset, values, active);
        m_film->put_block(block);
    }

    /// Each pixel gets the numbers that belong to it, whatever the lanes
    void seed(const Pass &pass, uint32_t first, const UInt32 &number, const UInt32 &pixel,
              const UInt32 &sample, uint32_t lanes, uint32_t samples) const {
        if (pass.sampler.indexed) {
            UInt32 first_key = pass.seed * dr::prod(m_size);
            dr::make_opaque(first_key);
            set_first_sample<Float, Spectrum>(
                m_sampler, UInt32(sample + dr::opaque<UInt32>(pass.first)));
            m_sampler->set_samples_per_wavefront(1);
            m_sampler->seed(first_key + pixel, lanes);
            return;
        }
        m_sampler->set_samples_per_wavefront(samples);
        UInt32 seed = pass.seed;
        if (!pass.sampler.pattern && first > 0)
            seed = mitsuba::sample_tea_32(seed, UInt32(first), 6).first;
        // A pattern depends on the number of a pixel's first lane: to be that of all samples
        bool whole = samples == m_sampler->sample_count() && pass.plan.role == Role::All;
        if (pass.sampler.pattern && whole) {
            seed += first * samples;
        } else if (pass.sampler.pattern) {
            dr::make_opaque(seed); // one kernel for all seeds
            seed += pixel * m_sampler->sample_count() - number * samples;
        }
        m_sampler->seed(seed, lanes);
    }

    const Integrator &m_integrator;
    const Scene *m_scene;
    Sensor *m_sensor;
    Film *m_film;
    Sampler *m_sampler;
    mitsuba::Vector<uint32_t, 2> m_size;
    size_t m_channels;
    bool m_has_part = false;
};

} // namespace manylights

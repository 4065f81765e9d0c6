#pragma once

/**
 * A pass of scalar variants: threads render blocks of the film, which become part of it in
 * their order. Sums depend neither on the number of threads nor on who is first.
 */

#include "passes.h"
#include <drjit/morton.h>
#include <map>
#include <mitsuba/core/progress.h>
#include <mitsuba/render/imageblock.h>
#include <mitsuba/render/integrator.h>
#include <mitsuba/render/sensor.h>
#include <mitsuba/render/spiral.h>
#include <mutex>

namespace manylights {

/// Holds finished blocks until it is their turn: no more than the film has
template <typename Float, typename Spectrum> class BlockQueue {
public:
    MI_IMPORT_TYPES(Film, ImageBlock)

    explicit BlockQueue(Film *film) : m_film(film) {}
    ~BlockQueue() {
        // Of a rendering that was stopped
        for (auto &[number, block] : m_waiting)
            m_film->put_block(block);
    }
    BlockQueue(const BlockQueue &) = delete;

    /// Returns how many are finished
    uint32_t put(uint32_t number, mitsuba::ref<ImageBlock> block) {
        std::lock_guard<std::mutex> guard(m_mutex);
        m_waiting[number] = block;
        for (auto it = m_waiting.begin(); it != m_waiting.end() && it->first == m_next;
             ++m_next) {
            m_film->put_block(it->second);
            m_free.push_back(it->second);
            it = m_waiting.erase(it);
        }
        return ++m_finished;
    }

    mitsuba::ref<ImageBlock> take(uint32_t side) {
        std::lock_guard<std::mutex> guard(m_mutex);
        if (m_free.empty())
            return m_film->create_block({ side, side }, /* normalize = */ false,
                                        /* border = */ true);
        mitsuba::ref<ImageBlock> block = m_free.back();
        m_free.pop_back();
        return block;
    }

private:
    std::mutex m_mutex;
    Film *m_film;
    std::map<uint32_t, mitsuba::ref<ImageBlock>> m_waiting;
    std::vector<mitsuba::ref<ImageBlock>> m_free;
    uint32_t m_next = 0, m_finished = 0;
};

template <typename Float, typename Spectrum, typename Integrator> class OrderedBlocks {
public:
    MI_IMPORT_TYPES(Scene, Sensor, Sampler, Film, ImageBlock)
    using Pass   = manylights::Pass<Float, Spectrum>;
    using Pixels = PixelSet<UInt32>;

    /// `side`: of the blocks, 0 for one that depends on the film's size alone
    OrderedBlocks(const Integrator &integrator, const Scene *scene, Sensor *sensor,
                  size_t channels, uint32_t side)
        : m_integrator(integrator), m_scene(scene), m_sensor(sensor),
          m_film(sensor->film()), m_size(film_size(m_film)), m_channels(channels),
          m_side(side ? side : default_side()) {}

    void render(const Pass &pass) const {
        SampleCount<Float, Spectrum> guard(m_sensor->sampler());
        m_sensor->sampler()->set_sample_count(pass.sampler_count);
        if (pass.sampler.indexed)
            set_first_sample<Float, Spectrum>(m_sensor->sampler(), pass.first);
        mitsuba::Spiral spiral(m_size, m_film->crop_offset(), m_side);
        BlockQueue<Float, Spectrum> queue(m_film);
        std::mutex mutex;
        mitsuba::ref<mitsuba::ProgressReporter> progress = progress_reporter();
        uint32_t count                                   = spiral.block_count(),
                 grain = std::max(count / (4 * ((uint32_t) pool_size() + 1)), 1u);
        dr::parallel_for(
            dr::blocked_range<uint32_t>(0, count, grain), [&](const auto &range) {
                mitsuba::ref<Sampler> sampler = m_sensor->sampler()->fork();
                std::unique_ptr<Float[]> aovs(new Float[m_channels]);
                for (uint32_t i = range.begin();
                     i != range.end() && !m_integrator.should_stop(); ++i) {
                    auto [offset, extent, number]  = spiral.next_block();
                    mitsuba::ref<ImageBlock> block = queue.take(m_side);
                    if (m_film->sample_border())
                        offset -= m_film->rfilter()->border_size();
                    block->set_size(extent);
                    block->set_offset(offset);
                    render_pixels(sampler, block, aovs.get(), pass);
                    uint32_t done = queue.put(number, block);
                    std::lock_guard<std::mutex> lock(mutex);
                    if (progress)
                        progress->update(pass.progress((float) done / (float) count));
                }
            });
    }

private:
    /// Enough blocks for many threads
    uint32_t default_side() const {
        uint32_t side = MI_BLOCK_SIZE;
        while (side > 1 && dr::prod((m_size + (side - 1)) / side) < 64)
            side /= 2;
        return side;
    }

    static mitsuba::ref<mitsuba::ProgressReporter> progress_reporter() {
        auto *logger = mitsuba::logger();
        return logger && mitsuba::Info >= logger->log_level()
                   ? new mitsuba::ProgressReporter("Rendering")
                   : nullptr;
    }

    /// Seeds belong to pixels: they do not depend on the size of blocks
    void render_pixels(Sampler *sampler, ImageBlock *block, Float *aovs,
                       const Pass &pass) const {
        Pixels pixels(m_size.x(), m_size.y(), pass.plan.role, pass.plan_seed);
        block->clear();
        for (uint32_t i = 0; i < m_side * m_side && !m_integrator.should_stop(); ++i) {
            auto at = dr::morton_decode<mitsuba::Point<uint32_t, 2>>(i);
            if (dr::any(at >= block->size()))
                continue;
            Point2i place = Point2i(at) + block->offset(),
                    pixel = place - Point2i(m_film->crop_offset());
            if (m_film->sample_border())
                pixel += m_film->rfilter()->border_size();
            uint32_t x = (uint32_t) pixel.x(), y = (uint32_t) pixel.y();
            if (!pixels.contains(x, y))
                continue;
            sampler->seed(pass.seed * dr::prod(m_size) + y * m_size.x() + x);
            if (!pass.sampler.indexed)
                skip(sampler, pass);
            for (uint32_t j = 0; j < pass.plan.count && !m_integrator.should_stop();
                 ++j) {
                m_integrator.render_sample(m_scene, m_sensor, sampler, block, aovs,
                                           Vector2f(place),
                                           dr::rsqrt((ScalarFloat) pass.spp), true);
                sampler->advance();
            }
        }
    }

    const Integrator &m_integrator;
    const Scene *m_scene;
    Sensor *m_sensor;
    Film *m_film;
    mitsuba::Vector<uint32_t, 2> m_size;
    size_t m_channels;
    uint32_t m_side;
};

} // namespace manylights

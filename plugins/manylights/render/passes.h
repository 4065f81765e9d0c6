#pragma once

/**
 * Parts of a rendering: which of each pixel's samples they have, and what a sampler has to be
 * told so that all of them together are those of one rendering.
 */

#include "pixel_set.h"
#include <drjit/jit.h>
#include <mitsuba/core/math.h>
#include <mitsuba/core/random.h>
#include <mitsuba/core/vector.h>
#include <mitsuba/render/film.h>
#include <mitsuba/render/sampler.h>
#include <mitsuba/render/sensor.h>
#include <stdexcept>
#include <string>
#include <string_view>

namespace manylights {

namespace dr = drjit;

/// Pixels that are rendered: with those beyond the border that the filter reaches, if wanted.
/// Throws if there are none
template <typename Film> mitsuba::Vector<uint32_t, 2> film_size(const Film *film) {
    auto size = film->crop_size();
    if (dr::prod(size) == 0)
        throw std::runtime_error("manylights: the film has " + std::to_string(size.x()) +
                                 " x " + std::to_string(size.y()) +
                                 " pixels, but must have at least 1 x 1.");
    if (film->sample_border())
        size += 2 * film->rfilter()->border_size();
    return size;
}

/// Does a parameter of the sensor have one entry for each sample of a rendering? All
/// samples are then rendered at once.
template <typename Float, typename Spectrum>
bool has_entry_for_each_sample(const mitsuba::Sensor<Float, Spectrum> *sensor) {
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
        const_cast<mitsuba::Sensor<Float, Spectrum> *>(sensor)->traverse(&visitor);
    }
    return visitor.entries > 1;
}

/// A rendering in words; no threads: those of Dr.Jit
inline std::string describe_job(const mitsuba::Vector<uint32_t, 2> &size, uint32_t spp,
                                size_t passes, size_t threads) {
    auto count = [](size_t number, const char *noun) {
        return std::to_string(number) + " " + noun + (number == 1 ? "" : "s");
    };
    std::string result = std::to_string(size.x()) + "x" + std::to_string(size.y()) +
                         ", " + count(spp, "sample");
    if (passes > 1)
        result += ", " + std::to_string(passes) + " passes";
    return threads > 0 ? result + ", " + count(threads, "thread") : result;
}

/// How a sampler's numbers belong together
struct SamplerKind {
    /// Any number of them can be drawn in any order
    bool independent;
    /// All of a pixel's samples form a pattern, which depends on the seed
    bool pattern;
    /// A pixel's samples can be asked for by their numbers
    bool indexed;

    /// Can some of the samples be drawn without the others?
    bool divides() const { return independent || indexed; }

    template <typename Sampler> explicit SamplerKind(const Sampler *sampler) {
        std::string_view name = sampler->class_name();
        independent           = name == "IndependentSampler";
        pattern = name == "StratifiedSampler" || name == "MultijitterSampler" ||
                  name == "OrthogonalSampler" || name == "LowDiscrepancySampler";
        indexed = name == "SobolSampler";
    }
};

/// Some of the samples of some pixels
template <typename Float, typename Spectrum> struct Pass {
    using UInt32  = dr::uint32_array_t<Float>;
    using Sampler = mitsuba::Sampler<Float, Spectrum>;

    PlannedPass plan;
    SamplerKind sampler;
    /// Samples per pixel of the rendering, and those that the sampler is told of
    uint32_t spp, sampler_count;
    /// Number of the pass's first sample among the latter
    uint32_t first;
    UInt32 seed;
    /// Of the rendering: which pixels train
    UInt32 plan_seed;

    /**
     * Passes of samplers with numbers have one seed, and those of a pattern if they share it.
     * @param job  a plan is followed, whose passes have patterns of their own
     */
    Pass(const PlannedPass &plan, const UInt32 &rendering, uint32_t spp, bool job,
         const Sampler *sampler)
        : plan(plan), sampler(sampler), spp(spp), sampler_count(spp), first(plan.first),
          seed(rendering), plan_seed(rendering) {
        if (plan.scramble > 0)
            seed = mitsuba::sample_tea_32(seed, UInt32(plan.scramble)).first;
        if (this->sampler.indexed || (this->sampler.pattern && !job))
            return;
        if (plan.first > 0 || plan.role == Role::Rest) {
            uint32_t number = plan.first | (plan.role == Role::Rest ? 1u << 31 : 0u);
            seed            = mitsuba::sample_tea_32(seed, UInt32(number), 5).first;
        }
        if (job || this->sampler.independent) {
            sampler_count = plan.count;
            first         = 0;
        }
    }

    /// Some of the samples, of a sampler that can divide them
    Pass piece(uint32_t begin, uint32_t count) const {
        Pass result       = *this;
        result.plan.count = count;
        if (sampler.indexed)
            result.first += begin;
        else if (sampler.independent)
            result.sampler_count = count;
        if (begin > 0 && !sampler.indexed)
            result.seed = mitsuba::sample_tea_32(seed, UInt32(begin), 7).first;
        return result;
    }

    /// Of the rendering, when a part of this pass is done
    float progress(float part) const {
        return ((float) plan.first + (float) plan.count * part) / (float) spp;
    }
};

/// A sampler with numbers begins with this one of each pixel; may be one for each lane
template <typename Float, typename Spectrum>
dr::uint32_array_t<Float> set_first_sample(mitsuba::Sampler<Float, Spectrum> *sampler,
                                           const dr::uint32_array_t<Float> &first) {
    using UInt32 = dr::uint32_array_t<Float>;
    struct Writer : mitsuba::TraversalCallback {
        UInt32 first;
        void put_value(std::string_view name, void *value, uint32_t,
                       const std::type_info &type) override {
            if (name == "first_sample" && type == typeid(UInt32))
                std::swap(*(UInt32 *) value, first);
        }
        void put_object(std::string_view, mitsuba::Object *, uint32_t) override {}
    } writer;
    writer.first = first;
    sampler->traverse(&writer);
    return writer.first;
}

/// The number of samples that a sampler had is its own again at the end, however that comes
template <typename Float, typename Spectrum> class SampleCount {
    using Sampler = mitsuba::Sampler<Float, Spectrum>;
    using UInt32  = dr::uint32_array_t<Float>;

public:
    explicit SampleCount(Sampler *sampler)
        : m_sampler(sampler), m_count(sampler->sample_count()) {
        if (SamplerKind(m_sampler).indexed)
            m_first = set_first_sample<Float, Spectrum>(m_sampler, dr::opaque<UInt32>(0));
    }
    ~SampleCount() {
        if (SamplerKind(m_sampler).indexed)
            set_first_sample<Float, Spectrum>(m_sampler, m_first);
        m_sampler->set_sample_count(m_count);
        if constexpr (dr::is_jit_v<Float>)
            m_sampler->set_samples_per_wavefront(m_count);
    }
    SampleCount(const SampleCount &) = delete;

private:
    Sampler *m_sampler;
    uint32_t m_count;
    UInt32 m_first = 0;
};

/// Go to the first sample of a pass. The random numbers within strata begin where those of
/// the first pass began: some are left out, so that none has the same use again.
template <typename Float, typename Spectrum>
void skip(mitsuba::Sampler<Float, Spectrum> *sampler, const Pass<Float, Spectrum> &pass) {
    constexpr uint32_t left_out = 5;
    for (uint32_t i = 0; pass.first > 0 && i < left_out; ++i)
        sampler->next_1d(true);
    for (uint32_t i = 0; i < pass.first; ++i)
        sampler->advance();
}

} // namespace manylights

#pragma once

/**
 * Parts of a rendering: which of each pixel's samples they have, and what a sampler has to be
 * told so that all of them together are those of one rendering.
 */

#include <drjit/jit.h>
#include <mitsuba/core/math.h>
#include <mitsuba/core/random.h>
#include <mitsuba/core/vector.h>
#include <mitsuba/render/film.h>
#include <mitsuba/render/sampler.h>
#include <string_view>

namespace manylights {

namespace dr = drjit;

/// Pixels that are rendered: with those beyond the border that the filter reaches, if wanted
template <typename Film> mitsuba::Vector<uint32_t, 2> film_size(const Film *film) {
    auto size = film->crop_size();
    if (film->sample_border())
        size += 2 * film->rfilter()->border_size();
    return size;
}

/// How a sampler's numbers belong together
struct SamplerKind {
    /// Any number of them can be drawn in any order
    bool independent;
    /// All of a pixel's samples form a pattern, which depends on the seed
    bool pattern;

    template <typename Sampler> explicit SamplerKind(const Sampler *sampler) {
        std::string_view name = sampler->class_name();
        independent           = name == "IndependentSampler";
        pattern = name == "StratifiedSampler" || name == "MultijitterSampler" ||
                  name == "OrthogonalSampler" || name == "LowDiscrepancySampler";
    }
};

/// Some of each pixel's samples, from number `first` on
template <typename Float, typename Spectrum> struct Pass {
    using UInt32  = dr::uint32_array_t<Float>;
    using Sampler = mitsuba::Sampler<Float, Spectrum>;

    uint32_t first, samples;
    UInt32 seed;
    SamplerKind sampler;

    /// The first pass has the seed of the rendering, and so have all that share a pattern
    Pass(const UInt32 &rendering, uint32_t number, uint32_t first, uint32_t samples,
         const Sampler *sampler)
        : first(first), samples(samples), seed(rendering), sampler(sampler) {
        if (number > 0 && !this->sampler.pattern)
            seed = mitsuba::sample_tea_32(rendering, UInt32(number)).first;
    }
};

/// The number of samples that a sampler had is its own again at the end, however that comes
template <typename Float, typename Spectrum> class SampleCount {
    using Sampler = mitsuba::Sampler<Float, Spectrum>;

public:
    explicit SampleCount(Sampler *sampler)
        : m_sampler(sampler), m_count(sampler->sample_count()) {}
    ~SampleCount() {
        m_sampler->set_sample_count(m_count);
        if constexpr (dr::is_jit_v<Float>)
            m_sampler->set_samples_per_wavefront(m_count);
    }
    SampleCount(const SampleCount &) = delete;

private:
    Sampler *m_sampler;
    uint32_t m_count;
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
 * than an eighth of the lanes would be left over. Of others, all up to the last one of the pass,
 * if their number divides the whole, or else all samples; those before the pass are masked.
 */
template <typename Float, typename Spectrum>
Wavefront wavefront(const Pass<Float, Spectrum> &pass, uint32_t spp) {
    uint32_t block = dr::is_cuda_v<Float> ? 32 : jit_llvm_block_size();
    block          = std::max(block, mitsuba::math::round_to_power_of_two(pass.samples));
    uint32_t lanes = pass.samples;
    if (pass.sampler.independent && block % lanes <= block / 8)
        return { block, block / lanes, lanes };
    if (!pass.sampler.independent) {
        lanes += pass.first;
        lanes = spp % lanes == 0 ? lanes : spp;
    }
    return { lanes, 1, lanes };
}

} // namespace manylights

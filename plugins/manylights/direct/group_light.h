#pragma once

/**
 * Light on its way to the film, summed for each group of lights (scene/light_groups.h). Where no
 * groups are asked for there are no sums, and nothing is computed.
 */

#include "manylights/base/loop.h"
#include "manylights/base/slots.h"
#include "manylights/choice/group_names.h"
#include <mitsuba/core/spectrum.h>

namespace manylights {

/// What has arrived of each group: the channels of the first group, then those of the next one
template <typename Float> using GroupSums = Slots<Float>;

/// Adds light of a vertex to the sums
template <typename Float, typename Spectrum> class GroupLight {
public:
    using UnpolarizedSpectrum = mitsuba::unpolarized_spectrum_t<Spectrum>;
    using UInt32D             = dr::uint32_array_t<dr::detached_t<Float>>;
    using Mask                = dr::mask_t<Float>;
    using Sums                = GroupSums<Float>;

    static constexpr size_t kChannels = dr::size_v<UnpolarizedSpectrum>;
    static_assert((kMostGroups + 1) * kChannels <= kMaxReservoirs + kMaxInfinite);

    /// Sums of zero for so many groups
    static Sums none_yet(uint32_t groups) {
        return make_slots<Float>(groups * kChannels, Float(0.f));
    }

    explicit GroupLight(Sums &sums) : m_sums(sums) {}

    /// Take the sums, which loops have to have in their states, and give them back
    Sums take() { return std::move(m_sums); }
    void give(Sums &&sums) { m_sums = std::move(sums); }

    bool is_wanted() const { return m_sums.size() > 0; }

    /// What all light of the vertex is multiplied by on its way to the film
    void set_factor(const Spectrum &factor) { m_factor = factor; }

    void add(const Spectrum &value, const UInt32D &group, const Mask &active) {
        add(m_sums, value, Float(1.f), group, active);
    }

    /**
     * The same for value * weight, in a loop that has the sums in its state. The product is made
     * here, and nothing is inlined: how scalar variants round the image stays as it is.
     */
    MI_NOINLINE void add(Sums &sums, const Spectrum &value, const Float &weight,
                         const UInt32D &group, const Mask &active) const {
        UnpolarizedSpectrum arrives =
            mitsuba::unpolarized_spectrum(m_factor * (value * weight));
        if constexpr (dr::is_jit_v<Float>) {
            for (uint32_t g = 0; g * kChannels < sums.size(); ++g) {
                Mask here = active && Mask(group == g);
                for (size_t i = 0; i < kChannels; ++i)
                    sums.entry(g * kChannels + i) +=
                        dr::select(here, arrives.entry(i), 0.f);
            }
        } else if (active) {
            for (size_t i = 0; i < kChannels; ++i)
                sums[group * kChannels + i] += arrives.entry(i);
        }
    }

private:
    Sums &m_sums;
    Spectrum m_factor;
};

} // namespace manylights

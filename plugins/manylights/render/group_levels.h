#pragma once

/// How bright the groups of lights are in what was rendered so far.

#include "film_channels.h"
#include "manylights/base/host_view.h"
#include "manylights/scene/light_groups.h"
#include <mitsuba/render/film.h>

namespace manylights {

/**
 * Sums of the layers of groups over a film, as numbers that do not depend on threads: eighths of
 * octaves below the brightest one, see LightGroups::set_levels. A group without any light counts
 * as bright: nothing is known of it.
 *
 * @param first_layer  the layers' first one among the channels that are not colours
 */
template <typename Float, typename Spectrum>
std::vector<uint32_t> group_levels(mitsuba::Film<Float, Spectrum> *film,
                                   size_t first_layer, uint32_t groups) {
    std::vector<uint32_t> levels(groups, 0);
    if (has_flag(film->flags(), mitsuba::FilmFlags::Special))
        return levels;
    auto raw = film->develop(/* raw = */ true);
    HostView pixels(raw.array());
    size_t channels = raw.shape(2), first = own_channels(film) + first_layer;
    std::vector<double> sums(groups, 0.);
    for (size_t pixel = 0; pixel < pixels.size(); pixel += channels)
        for (size_t i = 0; i < 3 * (size_t) groups; ++i) {
            double value = pixels[pixel + first + i];
            sums[i / 3] += std::isfinite(value) ? std::max(value, 0.) : 0.;
        }
    double most = *std::max_element(sums.begin(), sums.end());
    for (size_t group = 0; group < groups; ++group) {
        double octaves = sums[group] > 0 ? std::log2(most / sums[group]) : 0.;
        levels[group]  = (uint32_t) std::min(
            std::round(8 * octaves), (double) LightGroups<Float, Spectrum>::kLowestLevel);
    }
    return levels;
}

} // namespace manylights

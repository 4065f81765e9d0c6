#pragma once

/**
 * The channels that an integrator adds to those of the film, in their order: counts, then what
 * describes the surfaces.
 */

#include "aov_list.h"
#include "manylights/choice/parameters.h"

namespace manylights {

struct FilmChannels {
    std::vector<std::string> names;
    /// Where the surfaces' begin
    size_t aovs;

    FilmChannels(const SamplingParameters &params, const std::vector<Aov> &list)
        : names(count_channels(params)), aovs(names.size()) {
        auto more = channel_names(list);
        names.insert(names.end(), more.begin(), more.end());
    }

    /// How many describe the surfaces
    size_t aov_count() const { return names.size() - aovs; }
};

} // namespace manylights

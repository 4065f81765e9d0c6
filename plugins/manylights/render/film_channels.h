#pragma once

/**
 * The channels that an integrator adds to those of the film, in their order: counts, what
 * describes the surfaces, and the light of groups.
 */

#include "aov_list.h"
#include "manylights/choice/parameters.h"
#include <mitsuba/render/film.h>

namespace manylights {

/// How many channels of its own a film has before those: colours, alpha if wanted, the weight
template <typename Film> size_t own_channels(const Film *film) {
    return has_flag(film->flags(), mitsuba::FilmFlags::Alpha) ? 5 : 4;
}

struct FilmChannels {
    std::vector<std::string> names;
    /// Where the surfaces' begin, and the groups'
    size_t aovs, groups;
    /// Where each emission of the lamps in sight begins
    std::vector<size_t> emissions;

    FilmChannels(const SamplingParameters &params, const std::vector<Aov> &list)
        : names(count_channels(params)) {
        aovs = groups = names.size();
        for (const Aov &aov : list) {
            if (aov.type == AovType::Emission)
                emissions.push_back(names.size());
            groups = append(channel_names({ aov }));
        }
        append(group_channels(params.light_groups));
    }

    /// How many describe the surfaces
    size_t aov_count() const { return groups - aovs; }

private:
    /// Returns the number of all
    size_t append(const std::vector<std::string> &more) {
        names.insert(names.end(), more.begin(), more.end());
        return names.size();
    }
};

} // namespace manylights

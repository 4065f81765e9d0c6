#pragma once

/**
 * Parameters of our plugins, read and checked: an error names the plugin, the parameter, its
 * value and what is allowed.
 */

#include <mitsuba/core/properties.h>
#include <stdexcept>
#include <string>

namespace manylights {

[[noreturn]] inline void refuse(const mitsuba::Properties &props, const std::string &name,
                                const std::string &value, const std::string &allowed) {
    throw std::runtime_error(std::string(props.plugin_name()) + ": the parameter \"" +
                             name + "\" is " + value + ", but must be " + allowed + ".");
}

inline uint32_t read_count(const mitsuba::Properties &props, const std::string &name,
                           uint32_t fallback, uint32_t low, uint32_t high) {
    int64_t value = props.get<int64_t>(name, (int64_t) fallback);
    if (value < (int64_t) low || value > (int64_t) high)
        refuse(props, name, std::to_string(value),
               "an integer from " + std::to_string(low) + " to " + std::to_string(high));
    return (uint32_t) value;
}

} // namespace manylights

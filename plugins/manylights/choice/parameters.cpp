#include "parameters.h"

#include "manylights/base/properties.h"
#include <sstream>

namespace manylights {

namespace {

using mitsuba::Properties;

float read_rate(const Properties &props, float fallback) {
    const std::string name = "splitting_rate";
    // XML has no spelling of infinity for a float, so a string is welcome too
    if (props.has_property(name) && props.type(name) == Properties::Type::String) {
        std::string text = props.get<std::string>(name);
        if (text != "inf")
            refuse(props, name, "\"" + text + "\"", "a number >= 0 or \"inf\"");
        return std::numeric_limits<float>::infinity();
    }
    double value = props.get<double>(name, (double) fallback);
    if (!(value >= 0)) // NaN as well
        refuse(props, name, std::to_string(value), "a number >= 0 or \"inf\"");
    return (float) value;
}

/// The index of a string parameter in the list of what is allowed
size_t read_choice(const Properties &props, const std::string &name,
                   const std::vector<std::string> &choices) {
    std::string value = props.get<std::string>(name, choices[0]), allowed;
    for (size_t i = 0; i < choices.size(); ++i) {
        if (value == choices[i])
            return i;
        allowed += (i ? " or \"" : "\"") + choices[i] + "\"";
    }
    refuse(props, name, "\"" + value + "\"", allowed);
}

const std::vector<std::string> kMethods  = { "resampled_tree", "talk",
                                             "adaptive_splitting", "tree", "exhaustive" };
const std::vector<std::string> kLearning = { "false", "true", "keep" };
const std::vector<std::string> kSplitFunctions = { "near", "far" };

/// Learning is part of the default method
LearnVisibility read_learning(const Properties &props, Method method) {
    const std::string name = "learn_visibility";
    if (method != Method::ResampledTree) {
        if (props.has_property(name))
            refuse(props, name, "given",
                   "left out unless \"method\" is \"" + kMethods[0] + "\"");
        return LearnVisibility::No;
    }
    if (props.has_property(name) && props.type(name) == Properties::Type::String) {
        std::string text = props.get<std::string>(name);
        if (text != "keep")
            refuse(props, name, "\"" + text + "\"", "a boolean or \"keep\"");
        return LearnVisibility::Keep;
    }
    return props.get<bool>(name, true) ? LearnVisibility::Yes : LearnVisibility::No;
}

/// Parameters that would have no effect are mistakes
void refuse_unused(const Properties &props, const SamplingParameters &p) {
    auto refuse_given = [&](const char *name) {
        if (props.has_property(name))
            refuse(props, name, "given",
                   "left out where \"method\" is \"" + kMethods[(size_t) p.method] +
                       "\"");
    };
    bool one_descent = p.method == Method::Tree;
    if (one_descent || p.method == Method::Exhaustive)
        refuse_given("splitting_rate");
    if (one_descent || p.traces_all()) {
        refuse_given("reservoirs");
        refuse_given("shadow_rays");
    }
    if (props.has_property("split_function") && p.method != Method::Talk)
        refuse(props, "split_function",
               "\"" + kSplitFunctions[(size_t) p.split_function] + "\"",
               "left out unless \"method\" is \"talk\"");
}

/// What all integrators have in common
SamplingParameters read_light_parameters(const Properties &props) {
    SamplingParameters p;
    p.method         = (Method) read_choice(props, "method", kMethods);
    p.splitting_rate = read_rate(props, p.splitting_rate);
    p.reservoirs     = read_count(props, "reservoirs", p.reservoirs, 1, kMaxReservoirs);
    p.shadow_rays    = read_count(props, "shadow_rays",
                                  std::min(p.shadow_rays, p.reservoirs), 1, p.reservoirs);
    p.split_function =
        (SplitFunction) read_choice(props, "split_function", kSplitFunctions);
    p.counts           = props.get<bool>("counts", false);
    p.learn_visibility = read_learning(props, p.method);
    refuse_unused(props, p);
    if (p.method == Method::Exhaustive)
        p.splitting_rate = std::numeric_limits<float>::infinity();
    if (p.method == Method::Tree)
        p.splitting_rate = 0.f;
    if (p.method == Method::Tree || p.traces_all())
        p.reservoirs = p.shadow_rays = 1;
    return p;
}

} // namespace

SamplingParameters read_parameters(const Properties &props) {
    SamplingParameters p = read_light_parameters(props);
    p.bsdf_samples       = read_count(props, "bsdf_samples", p.bsdf_samples, 0, 1024);
    return p;
}

SamplingParameters read_path_parameters(const Properties &props) {
    SamplingParameters p = read_light_parameters(props);
    p.deeper_candidates  = 3.f / 8.f;
    p.deeper_rays        = 1.f / 4.f;
    return p;
}

std::vector<std::string> count_channels(const SamplingParameters &p) {
    if (!p.counts)
        return {};
    if (p.method == Method::ResampledTree)
        return { "candidates", "node_visits", "expected" };
    return { "candidates", "node_visits" };
}

std::string to_string(const SamplingParameters &p) {
    std::ostringstream oss;
    oss << "method = " << kMethods[(size_t) p.method];
    if (p.method == Method::Talk)
        oss << ",\nsplit_function = " << kSplitFunctions[(size_t) p.split_function];
    if (p.method != Method::Tree && p.method != Method::Exhaustive)
        oss << ",\nsplitting_rate = " << p.splitting_rate;
    if (p.method != Method::Tree && !p.traces_all())
        oss << ",\nreservoirs = " << p.reservoirs << ",\nshadow_rays = " << p.shadow_rays;
    if (p.method == Method::ResampledTree)
        oss << ",\nlearn_visibility = " << kLearning[(size_t) p.learn_visibility];
    oss << ",\ncounts = " << (p.counts ? "true" : "false");
    return oss.str();
}

} // namespace manylights

#include "parameters.h"

#include "manylights/base/properties.h"
#include <algorithm>
#include <limits>
#include <sstream>

namespace manylights {

namespace {

using mitsuba::Properties;
using Type = Parameter::Type;

[[noreturn]] void refuse(const Properties &props, const Parameter &about,
                         const std::string &value, const std::string &allowed) {
    manylights::refuse(props, std::string(about.name), value, allowed);
}

std::string quoted(std::string_view text) { return "\"" + std::string(text) + "\""; }

/// Which of the texts it is
size_t read_text(const Properties &props, const Parameter &about) {
    std::string value = props.get<std::string>(about.name);
    for (size_t i = 0; i < about.texts.size(); ++i)
        if (value == about.texts[i])
            return i;
    refuse(props, about, quoted(value), about.allowed(about.high));
}

/// The value of a parameter that is given; `high`: the upper end of its range
double read(const Properties &props, const Parameter &about, double high) {
    // XML has no spelling of infinity for a float, nor of what a boolean cannot tell
    bool is_text = props.type(about.name) == Properties::Type::String;
    if (about.type == Type::Text)
        return (double) read_text(props, about);
    if (about.type == Type::Boolean) {
        if (is_text && !about.texts.empty())
            return 2. + (double) read_text(props, about);
        return props.get<bool>(about.name);
    }
    if (about.type == Type::Integer) {
        int64_t value = props.get<int64_t>(about.name);
        if ((double) value < about.low || (double) value > high)
            refuse(props, about, std::to_string(value), about.allowed(high));
        return (double) value;
    }
    if (is_text && !about.texts.empty()) {
        read_text(props, about);
        return std::numeric_limits<double>::infinity();
    }
    double value = props.get<double>(about.name);
    if (!(value >= about.low)) // NaN as well
        refuse(props, about, std::to_string(value), about.allowed(high));
    return value;
}

/// What would have no effect is a mistake
void refuse_unused(const Properties &props, const Parameter &about, Method method) {
    if (about.is_for(method))
        return;
    bool is_text      = about.type == Type::Text;
    std::string value = is_text ? quoted(about.texts[read_text(props, about)]) : "given";
    bool is_for_one   = about.methods.size() == 1;
    refuse(props, about, value,
           std::string("left out ") + (is_for_one ? "unless" : "where") +
               " \"method\" is " +
               quoted(name_of(is_for_one ? about.methods[0] : method)));
}

/// Call f(name, member) for all parameters that we read; those whose values others depend on first
template <typename Params, typename F> void for_each_member(Params &p, const F &f) {
    f("method", p.method);
    f("split_function", p.split_function);
    f("splitting_rate", p.splitting_rate);
    f("reservoirs", p.reservoirs);
    f("shadow_rays", p.shadow_rays);
    f("learn_visibility", p.learn_visibility);
    f("counts", p.counts);
    f("bsdf_samples", p.bsdf_samples);
}

GroupNames read_groups(const Properties &props) {
    std::string text = props.get<std::string>("light_groups", "");
    try {
        return text.empty() ? GroupNames() : GroupNames(text);
    } catch (const std::invalid_argument &error) {
        refuse(props, parameter("light_groups"), quoted(text), error.what());
    }
}

SamplingParameters read(const Properties &props, Plugins plugin) {
    SamplingParameters p{};
    p.plugin = plugin;
    for_each_member(p, [&](std::string_view name, auto &member) {
        using Value            = std::decay_t<decltype(member)>;
        const Parameter &about = parameter(name);
        double high   = about.high_name == "reservoirs" ? p.reservoirs : about.high;
        double value  = std::min(about.fallback, high);
        bool is_given = (about.plugins & plugin) && props.has_property(name);
        if (is_given) {
            refuse_unused(props, about, p.method);
            value = read(props, about, high);
        }
        member = (Value) value;
    });
    p.light_groups = read_groups(props);
    // What the method does without
    if (p.method == Method::Exhaustive)
        p.splitting_rate = std::numeric_limits<float>::infinity();
    if (p.method == Method::Tree)
        p.splitting_rate = 0.f;
    if (!parameter("reservoirs").is_for(p.method))
        p.reservoirs = p.shadow_rays = 1;
    if (!parameter("learn_visibility").is_for(p.method))
        p.learn_visibility = LearnVisibility::No;
    return p;
}

} // namespace

SamplingParameters read_parameters(const Properties &props) {
    return read(props, kDirect);
}

SamplingParameters read_path_parameters(const Properties &props) {
    SamplingParameters p = read(props, kVolpath);
    int64_t max_depth    = props.get<int64_t>("max_depth", -1);
    p.several_bounces    = max_depth < 0 || max_depth > 2;
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
    for_each_member(p, [&](std::string_view name, const auto &member) {
        const Parameter &about = parameter(name);
        if (about.is_for(p.method) && (about.plugins & p.plugin))
            oss << (oss.tellp() > 0 ? ",\n" : "") << name << " = "
                << about.text_of((double) member);
    });
    if (!p.light_groups.empty())
        oss << ",\nlight_groups = " << quoted(p.light_groups.text());
    return oss.str();
}

} // namespace manylights

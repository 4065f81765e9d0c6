#include "parameter_table.h"

#include "manylights/base/slots.h"
#include <algorithm>
#include <limits>
#include <sstream>
#include <stdexcept>

namespace manylights {

namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();

using Type  = Parameter::Type;
using Texts = std::vector<std::string_view>;

/// A boolean, or one of the texts in its place
Parameter boolean(std::string_view name, unsigned plugins, bool fallback,
                  Texts texts = {}) {
    return { name,  plugins, Type::Boolean, (double) fallback, 0, 1, "", texts, {},
             false, "" };
}

Parameter integer(std::string_view name, unsigned plugins, double fallback, double low,
                  double high, std::string_view high_name = "") {
    return { name, plugins, Type::Integer, fallback, low, high, high_name,
             {},   {},      false,         "" };
}

Parameter number(std::string_view name, double fallback, Texts texts) {
    return {
        name, kBoth, Type::Number, fallback, 0, kInfinity, "", texts, {}, false, ""
    };
}

/// One of some texts, the default first
Parameter text(std::string_view name, Texts texts) {
    return { name, kBoth, Type::Text, 0, 0, 0, "", texts, {}, false, "" };
}

/// Any text, none if it is not given
Parameter free_text(std::string_view name) { return text(name, {}); }
/// Pairs of a name and one of some texts; none if it is not given
Parameter list(std::string_view name, Texts texts) {
    return { name, kBoth, Type::List, 0, 0, 0, "", texts, {}, false, "" };
}

/// With its meaning, and the methods that it is for (none: all)
Parameter with(Parameter p, std::string_view meaning, std::vector<Method> methods = {}) {
    p.meaning = meaning;
    p.methods = std::move(methods);
    return p;
}

Parameter inherited(Parameter p, std::string_view meaning) {
    p.is_inherited = true;
    return with(std::move(p), meaning);
}

std::vector<Parameter> make_table() {
    using M = Method;
    return {
        with(text("method", { "resampled_tree", "talk", "adaptive_splitting", "tree",
                              "exhaustive" }),
             "where candidates come from, and what becomes of them"),
        with(text("split_function", { "near", "far" }),
             "how the probability of splitting decays with distance", { M::Talk }),
        with(number("splitting_rate", 1, { "inf" }),
             "candidates at a point, in units of 16, on paths of 6, 4 and 2, in media "
             "half",
             { M::ResampledTree, M::Talk, M::AdaptiveSplitting }),
        with(integer("reservoirs", kBoth, 16, 1, kMaxReservoirs),
             "lights that are kept for a full evaluation",
             { M::ResampledTree, M::Talk, M::Exhaustive }),
        with(integer("shadow_rays", kBoth, 16, 1, kMaxReservoirs, "reservoirs"),
             "lights that are tested for visibility",
             { M::ResampledTree, M::Talk, M::Exhaustive }),
        with(boolean("learn_visibility", kBoth, true, { "keep" }),
             "learn which lights can be seen from where", { M::ResampledTree }),
        with(boolean("counts", kBoth, false), "film channels with numbers of candidates"),
        with(free_text("light_groups"), "film layers with the light of groups"),
        with(list("aovs", { "albedo", "depth", "position", "uv", "geo_normal",
                            "sh_normal", "dp_du", "dp_dv", "duv_dx", "duv_dy",
                            "prim_index", "shape_index", "emission" }),
             "film channels that describe the surfaces in sight"),
        with(integer("bsdf_samples", kDirect, 1, 0, 1024), "rays sampled from the BSDF"),
        inherited(integer("max_depth", kVolpath, -1, -1, kInfinity), "longest path"),
        inherited(integer("rr_depth", kVolpath, 5, 1, kInfinity),
                  "path depth from which on roulette is played"),
        inherited(boolean("hide_emitters", kBoth, false),
                  "does the camera see no emitters?"),
    };
}

} // namespace

bool Parameter::is_for(Method method) const {
    return methods.empty() ||
           std::find(methods.begin(), methods.end(), method) != methods.end();
}

std::string Parameter::allowed(double high) const {
    std::ostringstream oss;
    if (type == Type::Boolean)
        oss << "a boolean";
    else if (type == Type::Integer)
        oss << "an integer from " << low << " to " << high;
    else if (type == Type::Number)
        oss << "a number >= " << low;
    else if (type == Type::List)
        oss << "pairs NAME:TYPE between commas with a TYPE of ";
    for (size_t i = 0; i < texts.size(); ++i)
        oss << (i > 0 || type < Type::Text ? " or \"" : "\"") << texts[i] << "\"";
    return oss.str();
}

std::string Parameter::text_of(double value) const {
    if (type == Type::List || (type == Type::Text && texts.empty()))
        return "";
    if (type == Type::Text)
        return std::string(texts[(size_t) value]);
    if (type == Type::Boolean)
        return value > 1 ? std::string(texts[0]) : value > 0 ? "true" : "false";
    std::ostringstream oss;
    oss << (float) value;
    return oss.str();
}

const std::vector<Parameter> &parameter_table() {
    static const std::vector<Parameter> table = make_table();
    return table;
}

const Parameter &parameter(std::string_view name) {
    for (const Parameter &each : parameter_table())
        if (each.name == name)
            return each;
    throw std::logic_error("manylights: no parameter \"" + std::string(name) + "\"");
}

std::string_view name_of(Method method) {
    return parameter("method").texts[(size_t) method];
}

} // namespace manylights

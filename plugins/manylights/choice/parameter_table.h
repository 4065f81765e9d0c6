#pragma once

/**
 * The parameters of both integrators, each told once: what may be said of it by those who read,
 * refuse, print or document it. Plain C++, no Dr.Jit and no Mitsuba types.
 */

#include <string>
#include <string_view>
#include <vector>

namespace manylights {

/// Where candidates come from, and what becomes of them
enum class Method { ResampledTree, Talk, AdaptiveSplitting, Tree, Exhaustive };

/// Plugins that have a parameter, as bits
enum Plugins : unsigned { kDirect = 1, kVolpath = 2, kBoth = 3 };

struct Parameter {
    enum class Type { Boolean, Integer, Number, Text, List };

    std::string_view name;
    unsigned plugins;
    Type type;
    /// 1 for true; the index of a text, see `texts`
    double fallback;
    /// Range of numbers; the parameter of this name, if any, is the upper end instead
    double low, high;
    std::string_view high_name;
    /// What a text may be (none: anything), or the second half of each pair of a list, or else
    /// what may be given in place of a boolean (with the value 2) or a number (infinity)
    std::vector<std::string_view> texts;
    /// Methods in which it has an effect; given with others it is a mistake
    std::vector<Method> methods;
    /// Does a base class of Mitsuba read it?
    bool is_inherited;
    std::string_view meaning;

    bool is_for(Method method) const;
    /// What it must be, in words of an error message; `high`: the upper end of a range
    std::string allowed(double high) const;
    /// A value as users write it
    std::string text_of(double value) const;
};

/// In the order in which they are printed
const std::vector<Parameter> &parameter_table();

/// The one of that name; throws if there is none
const Parameter &parameter(std::string_view name);

/// The name of a method
std::string_view name_of(Method method);

} // namespace manylights

#include "aov_list.h"

#include "manylights/base/properties.h"
#include "manylights/choice/parameter_table.h"
#include <algorithm>
#include <mitsuba/core/string.h>

namespace manylights {

namespace {

const Parameter &about() { return parameter("aovs"); }

/// What follows a name and a point, a letter for each channel
std::string_view letters(AovType type) {
    switch (type) {
        case AovType::Albedo:
        case AovType::Emission:
            return "RGB";
        case AovType::Depth:
            return "T";
        case AovType::UV:
        case AovType::DuvDx:
        case AovType::DuvDy:
            return "UV";
        case AovType::PrimIndex:
        case AovType::ShapeIndex:
            return "I";
        case AovType::Position:
        case AovType::GeometricNormal:
        case AovType::ShadingNormal:
        case AovType::DpDu:
        case AovType::DpDv:
            break;
    }
    return "XYZ";
}

[[noreturn]] void refuse(const mitsuba::Properties &props, const std::string &text,
                         const std::string &allowed) {
    manylights::refuse(props, std::string(about().name), "\"" + text + "\"", allowed);
}

Aov read_aov(const mitsuba::Properties &props, const std::string &text) {
    const auto &types = about().texts;
    size_t colon      = text.find(':');
    if (colon == std::string::npos || colon == 0)
        refuse(props, text, about().allowed(0));
    auto type = std::find(types.begin(), types.end(), text.substr(colon + 1));
    if (type == types.end())
        refuse(props, text, about().allowed(0));
    return { text.substr(0, colon), (AovType) (type - types.begin()) };
}

} // namespace

std::vector<Aov> read_aovs(const mitsuba::Properties &props) {
    std::vector<Aov> result;
    if (!props.has_property(about().name))
        return result;
    std::string text = props.get<std::string>(about().name);
    if (text == "none") // as the help calls the default
        return result;
    for (const std::string &each : mitsuba::string::tokenize(text)) {
        Aov aov = read_aov(props, each);
        for (const Aov &other : result)
            if (other.name == aov.name)
                refuse(props, text, "of names that differ (\"" + aov.name + "\")");
        result.push_back(aov);
    }
    return result;
}

std::vector<std::string> channel_names(const std::vector<Aov> &aovs) {
    std::vector<std::string> result;
    for (const Aov &aov : aovs)
        for (char letter : letters(aov.type))
            result.push_back(aov.name + '.' + letter);
    return result;
}

std::string to_string(const std::vector<Aov> &aovs) {
    std::string result;
    for (const Aov &aov : aovs) {
        result += result.empty() ? "" : ", ";
        result += aov.name + ':' + std::string(about().texts[(size_t) aov.type]);
    }
    return result;
}

} // namespace manylights

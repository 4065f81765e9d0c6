#include "group_names.h"

#include <algorithm>
#include <stdexcept>

namespace manylights {

namespace {

constexpr std::string_view kRest    = "rest";
constexpr std::string_view kGrammar = "entries as \"key=lamp_*\", separated by commas";

/// Where the set that begins at `begin` ends: its closing bracket, or npos. One that comes
/// first is part of the set.
size_t end_of_set(std::string_view pattern, size_t begin) {
    size_t first = begin + 1;
    if (first < pattern.size() && pattern[first] == '!')
        ++first;
    return pattern.find(']', first + 1);
}

/// Is a character in the set between `begin` and `end`?
bool is_in_set(std::string_view pattern, size_t begin, size_t end, char c) {
    bool negated = pattern[begin + 1] == '!', found = false;
    for (size_t i = begin + 1 + negated; i < end; ++i) {
        bool range = i + 2 < end && pattern[i + 1] == '-';
        char last  = range ? pattern[i + 2] : pattern[i];
        found |= pattern[i] <= c && c <= last;
        i += range ? 2 : 0;
    }
    return found != negated;
}

bool is_name(std::string_view text) {
    return !text.empty() && std::all_of(text.begin(), text.end(), [](unsigned char c) {
        return (c < 128 && std::isalnum(c)) || c == '_' || c == '-';
    });
}

bool has_open_set(std::string_view pattern) {
    for (size_t i = 0; i < pattern.size(); ++i)
        if (pattern[i] == '[' && (i = end_of_set(pattern, i)) == std::string_view::npos)
            return true;
    return false;
}

/// Does the name of a light fit? Of a path of a USD stage the last part does, too, and what
/// follows # tells several lights of a prim apart.
bool fits_light(std::string_view pattern, std::string_view name) {
    if (fits(pattern, name))
        return true;
    if (name.empty() || name[0] != '/')
        return false;
    name = name.substr(0, name.find('#'));
    return fits(pattern, name) || fits(pattern, name.substr(name.rfind('/') + 1));
}

[[noreturn]] void refuse(const std::string &what) { throw std::invalid_argument(what); }

GroupNames::Entry read_entry(const std::string &text) {
    size_t equals = text.find('=');
    GroupNames::Entry entry{ text.substr(0, equals), "" };
    if (equals == std::string::npos || equals + 1 == text.size())
        refuse(std::string(kGrammar) + " (\"" + text + "\" is none)");
    entry.pattern = text.substr(equals + 1);
    if (!is_name(entry.group))
        refuse("groups with names of letters, digits, _ and - (\"" + entry.group +
               "\" is none)");
    if (entry.group == kRest)
        refuse("groups not called \"rest\", which has all lights of no group");
    if (has_open_set(entry.pattern))
        refuse("patterns in which each [ has its ] (\"" + entry.pattern + "\" has not)");
    return entry;
}

} // namespace

bool fits(std::string_view pattern, std::string_view text) {
    // Where to go on if the last star has to stand for one more character
    size_t p = 0, t = 0, star = std::string_view::npos, resume = 0;
    while (t < text.size() || p < pattern.size()) {
        if (p < pattern.size() && pattern[p] == '*') {
            star   = p++;
            resume = t;
            continue;
        }
        if (p < pattern.size() && t < text.size()) {
            size_t end = pattern[p] == '[' ? end_of_set(pattern, p) : p;
            bool same  = pattern[p] == '[' ? is_in_set(pattern, p, end, text[t])
                                           : pattern[p] == '?' || pattern[p] == text[t];
            if (same) {
                p = end + 1;
                ++t;
                continue;
            }
        }
        if (star == std::string_view::npos || resume == text.size())
            return false;
        p = star + 1;
        t = ++resume;
    }
    return true;
}

GroupNames::GroupNames(const std::string &text) : m_text(text) {
    size_t begin = 0;
    while (begin <= text.size()) {
        size_t end  = std::min(text.find(',', begin), text.size());
        Entry entry = read_entry(text.substr(begin, end - begin));
        if (std::find(m_groups.begin(), m_groups.end(), entry.group) == m_groups.end())
            m_groups.push_back(entry.group);
        m_entries.push_back(std::move(entry));
        begin = end + 1;
    }
    if (m_groups.size() > kMostGroups)
        refuse("at most " + std::to_string(kMostGroups) + " groups (it has " +
               std::to_string(m_groups.size()) + ")");
    m_groups.emplace_back(kRest);
    std::sort(
        m_groups.begin(), m_groups.end(),
        [](const std::string &a, const std::string &b) { return a + "." < b + "."; });
}

size_t GroupNames::entry_of(std::string_view name, std::string_view other) const {
    size_t i = 0;
    while (i < m_entries.size() && !fits_light(m_entries[i].pattern, name) &&
           !fits_light(m_entries[i].pattern, other))
        ++i;
    return i;
}

uint32_t GroupNames::group_of(size_t entry) const {
    std::string_view name = entry < m_entries.size() ? m_entries[entry].group : kRest;
    return (uint32_t) (std::find(m_groups.begin(), m_groups.end(), name) -
                       m_groups.begin());
}

std::string list_of_lights(const std::vector<std::string> &names) {
    constexpr size_t most = 8;
    std::string listed;
    size_t named = 0;
    for (const std::string &name : names)
        if (!name.empty() && ++named <= most)
            listed += (named == 1 ? ": \"" : ", \"") + name + "\"";
    listed += named > most ? ", ..." : "";
    std::string count =
        std::to_string(names.size()) + (names.size() == 1 ? " light" : " lights");
    if (named == names.size())
        return count + listed;
    std::string rest = " without an id";
    return named ? count + listed + " and " + std::to_string(names.size() - named) + rest
                 : count + rest;
}

std::vector<std::string> group_channels(const GroupNames &names) {
    std::vector<std::string> result;
    for (const std::string &group : names.groups())
        for (const char *channel : { "R", "G", "B" })
            result.push_back("RGBA_" + group + "." + channel);
    return result;
}

} // namespace manylights

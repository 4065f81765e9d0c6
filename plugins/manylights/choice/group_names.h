#pragma once

/**
 * Groups of lights, as users name them: "key=lamp_*,windows=facade". A light belongs to the first
 * entry one of whose names fits; all others are the group `rest`. Patterns are those of file
 * names: *, ?, [a-z] and [!a-z]; * fits / too. Of names that are paths (of USD) the last part is
 * a name, too. Plain C++, no Dr.Jit and no Mitsuba types.
 */

#include <cstddef>
#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

namespace manylights {

/// Groups that users may name; `rest` is one more
constexpr size_t kMostGroups = 16;

/// Does a text fit a pattern?
bool fits(std::string_view pattern, std::string_view text);

class GroupNames {
public:
    struct Entry {
        std::string group, pattern;
    };

    /// None
    GroupNames() = default;

    /// Read the text of a parameter; throws std::invalid_argument with what it must be
    explicit GroupNames(const std::string &text);

    bool empty() const { return m_entries.empty(); }
    const std::string &text() const { return m_text; }
    const std::vector<Entry> &entries() const { return m_entries; }

    /// Names of all groups, `rest` among them, in the order of their layers: that of the
    /// channels of OpenEXR files
    const std::vector<std::string> &groups() const { return m_groups; }

    /// The first entry that fits one of the names of a light, or how many there are
    size_t entry_of(std::string_view name, std::string_view other) const;

    /// Index into \ref groups, of the lights of an entry (or of those without one)
    uint32_t group_of(size_t entry) const;

private:
    std::string m_text;
    std::vector<Entry> m_entries;
    std::vector<std::string> m_groups;
};

/// Lights for an error: how many there are and the first of their names, empty ones counted
std::string list_of_lights(const std::vector<std::string> &names);

/// Names of the film channels with the layers of groups: "RGBA_key.R", ...
std::vector<std::string> group_channels(const GroupNames &names);

} // namespace manylights

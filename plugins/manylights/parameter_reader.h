#pragma once

/**
 * Reads the parameters of Mitsuba's objects on the host, through the interface that
 * `mi.traverse` uses: the classes of its plugins have no headers.
 */

#include <map>
#include <mitsuba/core/object.h>
#include <string>

namespace manylights {

/// The parameters of an object by name, children included ("intensity.value")
class ParameterReader : public mitsuba::TraversalCallback {
public:
    explicit ParameterReader(const mitsuba::Object *object) {
        const_cast<mitsuba::Object *>(object)->traverse(this);
    }

    /// The parameter as a `T`, or null if it is absent or of another type
    template <typename T> const T *find(const std::string &name) const {
        auto it = m_values.find(name);
        return it != m_values.end() && *it->second.second == typeid(T)
                   ? (const T *) it->second.first
                   : nullptr;
    }

    const mitsuba::Object *object(const std::string &name) const {
        auto it = m_objects.find(name);
        return it != m_objects.end() ? it->second : nullptr;
    }

protected:
    void put_value(std::string_view name, void *value, uint32_t,
                   const std::type_info &type) override {
        m_values[m_prefix + std::string(name)] = { value, &type };
    }

    void put_object(std::string_view name, mitsuba::Object *value, uint32_t) override {
        if (!value)
            return;
        std::string prefix                    = m_prefix;
        m_objects[prefix + std::string(name)] = value;
        m_prefix += std::string(name) + ".";
        value->traverse(this);
        m_prefix = prefix;
    }

private:
    std::string m_prefix;
    std::map<std::string, std::pair<void *, const std::type_info *>> m_values;
    std::map<std::string, mitsuba::Object *> m_objects;
};

} // namespace manylights

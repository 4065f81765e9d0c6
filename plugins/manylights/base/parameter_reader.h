#pragma once

/**
 * Reads the parameters of Mitsuba's objects on the host, through the interface that
 * `mi.traverse` uses: the classes of its plugins have no headers.
 */

#include <mitsuba/core/object.h>
#include <string_view>

namespace manylights {

/// The parameters of an object by name, children included ("intensity.value")
class ParameterReader {
public:
    explicit ParameterReader(const mitsuba::Object *object) : m_object(object) {}

    /// The parameter as a `T`, or null if it is absent or of another type
    template <typename T> const T *find(std::string_view name) const {
        Search search(m_object, name);
        return search.value && *search.type == typeid(T) ? (const T *) search.value
                                                         : nullptr;
    }

    const mitsuba::Object *object(std::string_view name) const {
        return Search(m_object, name).object;
    }

private:
    /// Visits only what lies on the way: scenes have many emitters
    struct Search : mitsuba::TraversalCallback {
        std::string_view rest;
        const void *value             = nullptr;
        const std::type_info *type    = nullptr;
        const mitsuba::Object *object = nullptr;

        Search(const mitsuba::Object *root, std::string_view name) : rest(name) {
            try {
                const_cast<mitsuba::Object *>(root)->traverse(this);
            } catch (const std::exception &) { // of a plugin written in Python
            }
        }

        void put_value(std::string_view name, void *v, uint32_t,
                       const std::type_info &t) override {
            if (name == rest) {
                value = v;
                type  = &t;
            }
        }

        void put_object(std::string_view name, mitsuba::Object *child,
                        uint32_t) override {
            if (!child || rest.substr(0, name.size()) != name)
                return;
            if (rest.size() == name.size()) {
                object = child;
            } else if (rest[name.size()] == '.') {
                std::string_view path = rest;
                rest.remove_prefix(name.size() + 1);
                child->traverse(this);
                rest = path;
            }
        }
    };

    const mitsuba::Object *m_object;
};

} // namespace manylights

#pragma once

/**
 * Which group of lights (choice/group_names.h) the lights of a scene belong to: those of the
 * table, those at infinity, and whatever a ray has hit. Groups have numbers, in the order of
 * their layers. Empty where no groups are asked for: nothing may be looked up then.
 */

#include "fingerprint.h"
#include "manylights/choice/group_names.h"
#include "manylights/tree/tree_view.h"
#include <algorithm>
#include <cmath>
#include <mitsuba/render/emitter.h>
#include <mitsuba/render/scene.h>
#include <mitsuba/render/shape.h>
#include <stdexcept>
#include <unordered_map>

namespace manylights {

template <typename Float, typename Spectrum> class LightGroups {
public:
    MI_IMPORT_TYPES(Scene, Emitter, Shape)
    using FloatD       = dr::detached_t<Float>;
    using UInt32D      = dr::uint32_array_t<FloatD>;
    using MaskD        = dr::mask_t<FloatD>;
    using Tree         = TreeView<FloatD>;
    using Storage      = typename Tree::Storage;
    using IndexStorage = typename Tree::IndexStorage;

    MANYLIGHTS_TRAVERSE(m_emitters, m_infinite, m_shapes, m_evening)

    LightGroups() = default;

    /// Throws if a group has no light
    LightGroups(const Scene *scene, const GroupNames &names,
                const std::vector<const Emitter *> &infinite) {
        if (names.empty())
            return;
        m_count = (uint32_t) names.groups().size();
        std::unordered_map<const Emitter *, uint32_t> group;
        for (uint32_t each : find_groups(scene, names)) {
            group[scene->emitters()[m_group_of_emitter.size()].get()] = each;
            m_group_of_emitter.push_back(each);
        }
        for (const Emitter *emitter : infinite)
            m_group_of_infinite.push_back(group[emitter]);
        if (scene->environment())
            m_environment = group[scene->environment()];
        find_shapes(scene, group);
        load(m_emitters, m_group_of_emitter);
        load(m_infinite, m_group_of_infinite);
    }

    /// How many groups there are, 0 if none are asked for
    uint32_t count() const { return m_count; }

    /// What is no array, see HostFacts
    void add_facts(Hash &facts) const {
        for (size_t fact : { (size_t) m_count, (size_t) m_environment,
                             (size_t) dr::width(m_shapes), m_levels.size() })
            facts.mix(fact);
    }

    /// Of a light of the table
    UInt32D of_light(const Tree &tree, const UInt32D &light, const MaskD &active) const {
        return at(m_emitters, tree.emitter(light, active), active);
    }

    /// Of one of the lights at infinity
    UInt32D of_infinite(const UInt32D &index, const MaskD &active) const {
        return at(m_infinite, index, active);
    }

    /// Of the surface that a ray has hit, or else of the environment; any if it does not emit
    UInt32D of_hit(const SurfaceInteraction3f &si) const {
        MaskD hit = plain(si.is_valid());
        if constexpr (dr::is_jit_v<Float>) {
            UInt32D id =
                plain(dr::reinterpret_array<dr::uint32_array_t<Float>>(si.shape));
            MaskD known = hit && id < (uint32_t) dr::width(m_shapes);
            return dr::select(hit, at(m_shapes, id, known), m_environment);
        } else {
            auto it = hit ? m_group_of_shape.find(si.shape) : m_group_of_shape.end();
            return it == m_group_of_shape.end() ? m_environment : it->second;
        }
    }

    /**
     * How bright the groups are, as far as is known: eighths of octaves below the brightest one,
     * see \ref group_levels. None: nothing is known.
     */
    const std::vector<uint32_t> &levels() const { return m_levels; }
    void set_levels(std::vector<uint32_t> levels) {
        if (levels == m_levels)
            return;
        m_levels = std::move(levels);
        std::vector<float> evening;
        for (uint32_t level : m_levels)
            evening.push_back(std::exp2((float) std::min(level, kLowestLevel) / 16.f));
        if (!evening.empty())
            m_evening = dr::load<Storage>(evening.data(), evening.size());
    }

    /// Is there a factor of targets for each group, that its noise is about as large as that of
    /// the others in relation to its light: one over the root of its brightness?
    bool evens() const { return !m_levels.empty(); }
    FloatD evening(const UInt32D &group, const MaskD &active) const {
        if constexpr (dr::is_jit_v<Float>)
            return dr::gather<FloatD>(m_evening, group, active);
        else
            return active ? m_evening.data()[group] : 1.f;
    }

    /// Groups that are darker are taken to be so bright: 2^-10 of the brightest one
    static constexpr uint32_t kLowestLevel = 80;

private:
    /// The group of each emitter
    static std::vector<uint32_t> find_groups(const Scene *scene,
                                             const GroupNames &names) {
        std::vector<uint32_t> result;
        std::vector<bool> used(names.entries().size() + 1, false);
        for (const auto &emitter : scene->emitters()) {
            const Shape *shape = emitter->shape();
            size_t entry       = names.entry_of(emitter->id(), shape ? shape->id() : "");
            used[entry]        = true;
            result.push_back(names.group_of(entry));
        }
        for (size_t i = 0; i < names.entries().size(); ++i)
            if (!used[i])
                refuse(scene, names, i);
        return result;
    }

    [[noreturn]] static void refuse(const Scene *scene, const GroupNames &names,
                                    size_t entry) {
        const auto &[group, pattern] = names.entries()[entry];
        std::vector<std::string> known;
        for (const auto &emitter : scene->emitters())
            known.push_back(name_of(emitter.get()));
        throw std::runtime_error(
            "manylights: in the parameter \"light_groups\", \"" + group + "=" + pattern +
            "\" matches no light that an entry before it has not. The scene has " +
            list_of_lights(known) + ".");
    }

    /// The id of its shape or else its own, which groups know it by, too; empty for none
    static std::string name_of(const Emitter *emitter) {
        const Shape *shape = emitter->shape();
        std::string id(shape ? shape->id() : emitter->id());
        return id.empty() ? std::string(emitter->id()) : id;
    }

    void find_shapes(const Scene *scene,
                     const std::unordered_map<const Emitter *, uint32_t> &group) {
        std::vector<uint32_t> ids(1, 0);
        for (const auto &shape : scene->shapes()) {
            // Some shapes (ellipsoidsmesh) do not tell their emitter about themselves
            auto it = group.find(shape->emitter());
            if (it == group.end())
                continue;
            if constexpr (dr::is_jit_v<Float>) {
                uint32_t id = jit_registry_id(shape.get());
                ids.resize(std::max(ids.size(), (size_t) id + 1), 0);
                ids[id] = it->second;
            } else {
                m_group_of_shape[shape.get()] = it->second;
            }
        }
        load(m_shapes, ids);
    }

    /// Never empty: kernels may refer to it with all lanes inactive
    static void load(IndexStorage &storage, std::vector<uint32_t> numbers) {
        if (numbers.empty())
            numbers.push_back(0);
        storage = dr::load<IndexStorage>(numbers.data(), numbers.size());
    }

    static UInt32D at(const IndexStorage &storage, const UInt32D &index,
                      const MaskD &active) {
        if constexpr (dr::is_jit_v<Float>)
            return dr::gather<UInt32D>(storage, index, active);
        else
            return active ? storage.data()[index] : 0u;
    }

    uint32_t m_count = 0, m_environment = 0;
    std::vector<uint32_t> m_group_of_emitter, m_group_of_infinite;
    /// Scalar variants; others have the shapes by their numbers in the registry
    std::unordered_map<const Shape *, uint32_t> m_group_of_shape;
    IndexStorage m_emitters, m_infinite, m_shapes;
    std::vector<uint32_t> m_levels;
    Storage m_evening;
};

} // namespace manylights

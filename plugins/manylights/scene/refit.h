#pragma once

/**
 * Follows a change of what some emitters emit, without a new tree: colours, fluxes and moments.
 *
 * Lights with power stay where they are; those that had none are missing. What has got a
 * gradient leaves the table, but not its place; without it, there is a new tree. Binary
 * nodes are not kept up to date.
 */

#include "fingerprint.h"
#include "manylights/base/host_storage.h"
#include "manylights/table/light_table.h"
#include "manylights/tree/tree_view.h"
#include <atomic>

namespace manylights {

template <typename Float, typename Spectrum> class LightRefit {
public:
    using Scene        = mitsuba::Scene<Float, Spectrum>;
    using FloatD       = dr::detached_t<Float>;
    using Tree         = TreeView<FloatD>;
    using Storage      = typename Tree::Storage;
    using IndexStorage = typename Tree::IndexStorage;
    using Change       = typename Fingerprint<Float>::Change;

    /// `nodes`: how many the tree has; `proportional`: see HostTable
    LightRefit(const Scene *scene, Tree &tree, uint32_t nodes,
               const std::vector<bool> &proportional,
               const IndexStorage &light_of_primitive)
        : m_scene(scene), m_tree(tree), m_nodes(nodes), m_proportional(proportional),
          m_light_of_primitive(light_of_primitive) {}

    /// False if that is not possible; the lights are then of no use any more
    bool run(const std::vector<Change> &changed) {
        std::vector<Emission> emission;
        std::vector<uint32_t> index(m_proportional.size(), kNone); // into `emission`
        std::vector<uint32_t> differentiated;
        for (const Change &change : changed) {
            uint32_t i = change.emitter;
            if (change.differentiated) {
                differentiated.push_back(i);
                continue;
            }
            Emission e =
                EmissionReader<Float, Spectrum>::read(m_scene->emitters()[i].get());
            if (change.was_differentiated || !m_proportional[i] || !e.tabulated ||
                !(e.brightness > 0) || !std::isfinite(e.brightness))
                return false;
            index[i] = (uint32_t) emission.size();
            emission.push_back(e);
        }
        return changed.empty() || update(emission, index, differentiated);
    }

    /// Are there emissive surfaces now whose radiance is not in the table?
    bool needs_emitter_eval() const { return m_needs_emitter_eval; }

private:
    /// `index`: of each emitter into `emission`
    bool update(const std::vector<Emission> &emission, const std::vector<uint32_t> &index,
                const std::vector<uint32_t> &differentiated) {
        HostStorage<Storage> row_storage, node_storage;
        HostVector<float> fluxes(m_tree.light_count);
        LightRow *rows  = (LightRow *) row_storage.open(m_tree.rows);
        WideNode *nodes = (WideNode *) node_storage.open(m_tree.nodes);
        bool beams      = m_tree.directions == Directions::Beams;
        std::atomic<bool> valid{ replace_rows(differentiated, rows) };
        std::vector<double> largest(chunk_count(m_tree.light_count), 0.);
        for_chunks(m_tree.light_count, [&](size_t chunk, size_t begin, size_t end) {
            for (size_t i = begin; i < end; ++i) {
                LightRow &row = rows[i];
                uint32_t e    = index[row.tag >> kTagEmitterShift];
                if (e != kNone)
                    set_emission(row, emission[e]);
                double flux = light_flux(row, beams);
                if (!(flux > 0) || !std::isfinite(flux))
                    valid = false;
                largest[chunk] = std::max(largest[chunk], flux);
            }
        });
        if (!valid)
            return false;
        float scale = flux_scale(*std::max_element(largest.begin(), largest.end()));
        for_chunks(m_tree.light_count, [&](size_t, size_t begin, size_t end) {
            for (size_t i = begin; i < end; ++i)
                fluxes[i] = scaled_flux(light_flux(rows[i], beams), scale);
        });
        m_tree.set_scale(scale);
        refit_tree(nodes, m_nodes, fluxes);
        m_tree.top   = TopView<FloatD>(read_top(nodes));
        m_tree.rows  = row_storage.close();
        m_tree.nodes = node_storage.close();
        return true;
    }

    /// Read all lights of some emitters again, each to the place that it has. False if others
    /// have power than before.
    bool replace_rows(const std::vector<uint32_t> &emitters, LightRow *rows) {
        if (emitters.empty())
            return true;
        std::vector<std::vector<uint32_t>> places = places_of(emitters, rows);
        for (size_t i = 0; i < emitters.size(); ++i) {
            auto table =
                LightTableReader<Float, Spectrum>::read_one(m_scene, emitters[i]);
            if (!table || table->rows.size() != places[i].size())
                return false;
            for (size_t k = 0; k < places[i].size(); ++k) {
                LightRow &row = rows[places[i][k]], read = table->rows[k];
                // Other triangles may have power than before
                bool triangle = kind_of(read) == LightKind::Triangle;
                if (triangle &&
                    !std::equal(row.geometry, row.geometry + 9, read.geometry))
                    return false;
                read.link = row.link;
                row       = read;
            }
            m_tree.kinds.bits |= table->kinds.bits;
            m_needs_emitter_eval |= table->needs_emitter_eval;
        }
        return true;
    }

    /// Where the lights of emitters are, in the order in which they are read
    std::vector<std::vector<uint32_t>> places_of(const std::vector<uint32_t> &emitters,
                                                 const LightRow *rows) const {
        std::vector<uint32_t> index(m_proportional.size(), kNone);
        for (size_t i = 0; i < emitters.size(); ++i)
            index[emitters[i]] = (uint32_t) i;
        std::vector<std::vector<uint32_t>> places(emitters.size());
        for (uint32_t i = 0; i < m_tree.light_count; ++i)
            if (uint32_t e = index[rows[i].tag >> kTagEmitterShift]; e != kNone)
                places[e].push_back(i);
        // Of a mesh, in the order of its primitives
        HostView lights(m_light_of_primitive);
        std::vector<uint32_t> order(m_tree.light_count, kNone);
        for (uint32_t i = 0; i < lights.size(); ++i)
            if (lights[i] < kOnlyHit)
                order[lights[i]] = i;
        for (auto &list : places)
            std::sort(list.begin(), list.end(),
                      [&](uint32_t a, uint32_t b) { return order[a] < order[b]; });
        return places;
    }

    static void set_emission(LightRow &row, const Emission &e) {
        row.brightness = e.brightness;
        if (!(row.tag & kTagTabulated))
            return;
        std::copy_n(e.color, 3, row.color);
        row.scale = e.scale;
    }

    const Scene *m_scene;
    Tree &m_tree;
    uint32_t m_nodes;
    const std::vector<bool> &m_proportional;
    const IndexStorage &m_light_of_primitive;
    bool m_needs_emitter_eval = false;
};

} // namespace manylights

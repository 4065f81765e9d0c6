#pragma once

/**
 * The lights of one scene, ready for the kernels: table and tree in device memory, the
 * map from a hit to its light, and a fingerprint that tells when to build it anew.
 */

#include "fingerprint.h"
#include "manylights/table/light_table.h"
#include "manylights/tree/tree_view.h"
#include "media.h"
#include <atomic>
#include <chrono>
#include <mitsuba/render/bsdf.h>
#include <unordered_map>

namespace manylights {

/// Memory on the host that is filled or changed there and becomes an array for kernels
template <typename Storage> class HostStorage {
public:
    using Value = dr::scalar_t<Storage>;

    /// Memory for `size` numbers, not initialized
    Value *allocate(size_t size) {
        if constexpr (dr::is_cuda_v<Storage>) {
            m_copy.resize(size);
            return m_copy.data();
        } else {
            m_array = dr::empty<Storage>(size);
            return host_data();
        }
    }

    /// The numbers of an array, which is taken away. They are copied if kernels that have
    /// not run yet need the array as it is
    Value *open(Storage &array) {
        if constexpr (dr::is_cuda_v<Storage>) {
            HostView view(array);
            m_copy.assign(view.data(), view.data() + view.size());
            return m_copy.data();
        } else {
            m_array = std::move(array);
            if constexpr (dr::is_jit_v<Storage>)
                if (jit_var_ref(m_array.index()) > 1)
                    m_array = dr::load<Storage>(HostView(m_array).data(), m_array.size());
            return host_data();
        }
    }

    Storage close() {
        if constexpr (dr::is_cuda_v<Storage>)
            return dr::load<Storage>(m_copy.data(), m_copy.size());
        else
            return std::move(m_array);
    }

private:
    Value *host_data() {
        Value *data = m_array.data();
        // Kernels that run may still use this memory
        if constexpr (dr::is_jit_v<Storage>)
            dr::sync_thread();
        return data;
    }

    Storage m_array;
    HostVector<Value> m_copy;
};

template <typename Float, typename Spectrum> class SceneLights : public mitsuba::Object {
public:
    MI_IMPORT_TYPES(Scene, Emitter, EmitterPtr, Shape, ShapePtr)
    using FloatD  = dr::detached_t<Float>;
    using UInt32D = dr::uint32_array_t<FloatD>;
    using MaskD   = dr::mask_t<FloatD>;
    using Tree    = TreeView<FloatD>;

    /// Numbers for users: `manylights tree`, `mi.traverse(integrator)`, `to_string()`
    struct Statistics {
        uint32_t lights = 0, lights_in_tree = 0, nodes = 0, depth = 0;
        double bytes   = 0;
        float build_ms = 0;
        /// Time of the last refit since then, 0 if there was none
        float refit_ms = 0;
    };

    SceneLights(const Scene *scene, bool keep_binary) {
        Stopwatch stopwatch;
        Table table = LightTableReader<Float, Spectrum>::read(scene);
        m_infinite  = std::move(table.infinite);
        if (!m_infinite.empty())
            m_infinite_dr = dr::load<mitsuba::DynamicBuffer<EmitterPtr>>(
                m_infinite.data(), m_infinite.size());
        m_proportional       = std::move(table.proportional);
        m_needs_emitter_eval = table.needs_emitter_eval;
        m_can_be_hit         = table.can_be_hit;
        m_tree.kinds         = table.kinds;
        m_tree.directions    = directions(table);
        m_only_hit           = table.only_hit;
        m_first_only_hit     = table.first_only_hit;
        set_scale(table.scale);
        m_lobes            = find_lobes(scene);
        m_media            = Media<Float, Spectrum>::find(scene);
        m_tree.light_count = (uint32_t) table.rows.size();

        HostStorage<Storage> nodes;
        WideNode *nodes_begin = nullptr;
        auto node_memory      = [&](size_t count) {
            return nodes_begin = (WideNode *) nodes.allocate(count * kWideNodeFloats);
        };
        LightTree tree = build_tree(std::move(table.bounds), node_memory, keep_binary);
        if (tree.wide_count > 0)
            m_tree.top = TopView<FloatD>(read_top(nodes_begin));
        m_tree.nodes = or_empty(nodes.close());
        // Never empty either
        tree.node_link.push_back(kNone);
        m_tree.node_links =
            dr::load<IndexStorage>(tree.node_link.data(), tree.node_link.size());
        m_tree.binary = or_empty(dr::load<Storage>(
            tree.binary.data(), tree.binary.size() * kBinaryNodeFloats));
        make_rows(table, tree);
        make_map(table, tree);
        if constexpr (dr::is_jit_v<Float>)
            dr::eval(m_tree.nodes, m_tree.node_links, m_tree.binary, m_tree.rows,
                     m_shape_lights, m_light_of_primitive);

        m_statistics.lights         = table.light_count;
        m_statistics.lights_in_tree = m_tree.light_count;
        m_statistics.nodes          = tree.wide_count;
        m_statistics.depth          = tree.depth;
        m_statistics.bytes =
            sizeof(float) *
            ((double) dr::width(m_tree.nodes) + dr::width(m_tree.node_links) +
             dr::width(m_tree.binary) + dr::width(m_tree.rows) +
             dr::width(m_light_of_primitive) + dr::width(m_shape_lights));
        m_statistics.build_ms = stopwatch.milliseconds();
    }

    using Change = typename Fingerprint<Float>::Change;

    /**
     * Follow a change of what some emitters emit, without a new tree: colours, fluxes and
     * moments. False if that is not possible; the lights are then of no use any more.
     *
     * Lights with power stay where they are; those that had none are missing. What has got a
     * gradient leaves the table, but not its place; without it, there is a new tree. Binary
     * nodes are not kept up to date.
     */
    bool refit(const Scene *scene, const std::vector<Change> &changed) {
        Stopwatch stopwatch;
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
                EmissionReader<Float, Spectrum>::read(scene->emitters()[i].get());
            if (change.was_differentiated || !m_proportional[i] || !e.tabulated ||
                !(e.brightness > 0) || !std::isfinite(e.brightness))
                return false;
            index[i] = (uint32_t) emission.size();
            emission.push_back(e);
        }
        if (!changed.empty() && !refit(scene, emission, index, differentiated))
            return false;
        m_statistics.refit_ms = stopwatch.milliseconds();
        return true;
    }

    static Fingerprint<Float> fingerprint(const Scene *scene) {
        Fingerprint<Float> result(scene->emitters().size());
        dr::mask_t<Float> active(true);
        for (const auto &emitter : scene->emitters()) {
            const Shape *shape = emitter->shape();
            uint32_t flags     = emitter->flags(active);
            bool infinite      = has_flag(flags, mitsuba::EmitterFlags::Infinite);
            // Of those at infinity only pointers are kept
            if (infinite && !shape)
                result.add_untouched(emitter.get());
            else
                result.add_emitter(emitter.get());
            result.mix(flags);
            if (shape) {
                result.add(shape);
                result.mix(shape->has_flipped_normals());
            }
            // Kernels know them by number: another object may have got the address
            if constexpr (dr::is_jit_v<Float>)
                if (shape || infinite)
                    result.mix(jit_registry_id(shape ? (const void *) shape
                                                     : (const void *) emitter.get()));
        }
        // The same emitters may belong to another scene: a new one that lies in memory
        // where a deleted one lay
        MediaKinds media = Media<Float, Spectrum>::find(scene);
        result.mix_common((uint32_t) find_lobes(scene) + 4 * media.bits());
        return result;
    }

    /// For integrators that trace no rays from surfaces to find lights with
    void warn_of_lights_for_rays() const {
        if (m_only_hit > 0)
            Log(mitsuba::Warn,
                "%u of the scene's emitters can only be found by rays, and are missing "
                "because "
                "\"bsdf_samples\" is 0: no point can be chosen on them, or no light was "
                "found "
                "on them. The first one belongs to \"%s\".",
                m_only_hit, m_first_only_hit);
    }

    const Tree &tree() const { return m_tree; }

    /**
     * Learn the lights' visibility from now on: anew, or in addition to what was kept if the
     * shapes are still the same. The table has 512 records for each node, about as many as
     * there are cells in sight, but no more than samples are expected, and at most 38 MB.
     */
    void start_learning(const Scene *scene, const CellSize &size, double samples,
                        bool keep) {
        double wanted    = std::min(512. * m_statistics.nodes, samples);
        uint32_t records = 1u << 12;
        while (records < kMostRecords && records < wanted)
            records *= 2;
        Fingerprint<Float> shapes(0);
        if (keep)
            for_each_shape(scene, [&](const Shape *shape) { shapes.add_emitter(shape); });
        if (keep && m_visibility && shapes.same_places(m_learnt_shapes)) {
            m_visibility->prepare(records, size);
        } else {
            m_visibility    = std::make_unique<VisibilityTable<FloatD>>(records, size);
            m_learnt_shapes = std::move(shapes);
            m_learnt_shapes.hold();
        }
        m_visibility->set_counting(true);
        m_tree.visibility = m_visibility.get();
    }

    /// Use what was learnt so far, if it is worth it, and learn on if that is wanted and worth
    /// it, too. Returns whether it does.
    bool learn(bool go_on) {
        float gain = m_visibility->learn();
        if (gain < kLeastGain)
            m_tree.visibility = nullptr;
        go_on = go_on && gain > kLargeGain;
        m_visibility->set_counting(go_on);
        return go_on;
    }

    void stop_learning(bool keep) {
        m_visibility->set_counting(false);
        if (keep)
            return;
        m_tree.visibility = nullptr;
        m_visibility.reset();
    }

    /// The lobes that its surfaces have
    Lobes lobes() const { return m_lobes; }
    /// Kinds of light that are sampled from the table
    KindSet table_kinds() const {
        return { m_tree.kinds.bits & ~(1u << (uint32_t) LightKind::Other) };
    }
    /// Media of the shapes and sensors
    const MediaKinds &media() const { return m_media; }
    const std::vector<const Emitter *> &infinite() const { return m_infinite; }
    /// The same as a buffer for kernels
    const mitsuba::DynamicBuffer<EmitterPtr> &infinite_dr() const {
        return m_infinite_dr;
    }
    const Statistics &statistics() const { return m_statistics; }
    /// Can a ray hit any light at all? If not, BSDF sampling cannot contribute
    bool can_be_hit() const { return m_can_be_hit; }
    /// Is there an emissive surface whose radiance is not in the table?
    bool needs_emitter_eval() const { return m_needs_emitter_eval; }

    /// The light that a primitive of a shape is, kOnlyHit, or kNone
    UInt32D find(const ShapePtr &shape, const UInt32D &primitive,
                 const MaskD &active) const {
        if constexpr (dr::is_jit_v<Float>) {
            UInt32D id  = plain(dr::reinterpret_array<dr::uint32_array_t<Float>>(shape));
            using Pair  = dr::Array<UInt32D, 2>;
            MaskD known = active && id < (uint32_t) (dr::width(m_shape_lights) / 2);
            Pair range  = dr::gather<Pair>(m_shape_lights, id, known);
            known &= range.y() > 0u;
            UInt32D index = range.x() + dr::minimum(primitive, range.y() - 1u);
            UInt32D light = dr::gather<UInt32D>(m_light_of_primitive, index, known);
            return dr::select(known, light, kNone);
        } else {
            // Most shapes do not emit: do not look for these. Instances have no shape yet
            bool emits = active && shape != nullptr && shape->emitter() != nullptr;
            auto it    = emits ? m_shape_map.find(shape) : m_shape_map.end();
            if (it == m_shape_map.end())
                return kNone;
            return m_light_of_primitive
                .data()[it->second.first + std::min(primitive, it->second.count - 1)];
        }
    }

    MI_DECLARE_CLASS(SceneLights)

private:
    using Table        = HostTable<Float, Spectrum>;
    using Storage      = typename Tree::Storage;
    using IndexStorage = typename Tree::IndexStorage;

    static Directions directions(const Table &table) {
        if (table.beams)
            return Directions::Beams;
        for (const LightBounds &bounds : table.bounds)
            if (bounds.axis[0] != 0 || bounds.axis[1] != 0 || bounds.axis[2] != 0)
                return Directions::Broad;
        return Directions::All;
    }

    static Lobes find_lobes(const Scene *scene) {
        Lobes result = Lobes::None;
        for_each_shape(scene, [&](const Shape *shape) {
            uint32_t flags = shape->bsdf() ? shape->bsdf()->flags() : 0;
            if (has_flag(flags, mitsuba::BSDFFlags::GlossyTransmission))
                result = Lobes::Transmitted;
            else if (has_flag(flags, mitsuba::BSDFFlags::Glossy))
                result = std::max(result, Lobes::Reflected);
        });
        return result;
    }

    class Stopwatch {
    public:
        float milliseconds() const {
            auto time = std::chrono::steady_clock::now() - m_start;
            return std::chrono::duration<float, std::milli>(time).count();
        }

    private:
        std::chrono::steady_clock::time_point m_start = std::chrono::steady_clock::now();
    };

    /// Never empty: kernels may refer to it with all lanes inactive
    static Storage or_empty(const Storage &array) {
        return dr::width(array) ? array
                                : dr::zeros<Storage>(kWideNodeFloats * kRowFloats);
    }

    /// The table's rows in the order of the tree
    void make_rows(Table &table, const LightTree &tree) {
        HostStorage<Storage> storage;
        size_t count = table.rows.size();
        if (count > 0) {
            LightRow *rows = (LightRow *) storage.allocate(count * kRowFloats);
            for_chunks(count, [&](size_t, size_t begin, size_t end) {
                for (size_t i = begin; i < end; ++i) {
                    rows[i]      = table.rows[tree.order[i]];
                    rows[i].link = tree.link[i];
                }
            });
        }
        m_tree.rows = or_empty(storage.close());
        HostVector<LightRow>().swap(table.rows);
    }

    bool refit(const Scene *scene, const std::vector<Emission> &emission,
               const std::vector<uint32_t> &index,
               const std::vector<uint32_t> &differentiated) {
        HostStorage<Storage> row_storage, node_storage;
        HostVector<float> fluxes(m_tree.light_count);
        LightRow *rows  = (LightRow *) row_storage.open(m_tree.rows);
        WideNode *nodes = (WideNode *) node_storage.open(m_tree.nodes);
        bool beams      = m_tree.directions == Directions::Beams;
        std::atomic<bool> valid{ replace_rows(scene, differentiated, rows) };
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
        set_scale(scale);
        refit_tree(nodes, m_statistics.nodes, fluxes);
        m_tree.top   = TopView<FloatD>(read_top(nodes));
        m_tree.rows  = row_storage.close();
        m_tree.nodes = node_storage.close();
        return true;
    }

    /// Read all lights of some emitters again, each to the place that it has. False if others
    /// have power than before.
    bool replace_rows(const Scene *scene, const std::vector<uint32_t> &emitters,
                      LightRow *rows) {
        if (emitters.empty())
            return true;
        std::vector<std::vector<uint32_t>> places = places_of(emitters, rows);
        for (size_t i = 0; i < emitters.size(); ++i) {
            auto table = LightTableReader<Float, Spectrum>::read_one(scene, emitters[i]);
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

    void set_scale(float scale) {
        m_tree.scale = dr::opaque<FloatD>(scale);
        m_tree.unit  = dr::opaque<FloatD>(1.f / scale);
    }

    static void set_emission(LightRow &row, const Emission &e) {
        row.brightness = e.brightness;
        if (!(row.tag & kTagTabulated))
            return;
        std::copy_n(e.color, 3, row.color);
        row.scale = e.scale;
    }

    void make_map(const Table &table, const LightTree &tree) {
        HostVector<uint32_t> position(tree.order.size());
        for_chunks(position.size(), [&](size_t, size_t begin, size_t end) {
            for (size_t i = begin; i < end; ++i)
                position[tree.order[i]] = (uint32_t) i;
        });
        HostStorage<IndexStorage> storage;
        size_t count     = table.light_of_primitive.size();
        uint32_t *lights = storage.allocate(count + 1);
        for_chunks(count, [&](size_t, size_t begin, size_t end) {
            for (size_t i = begin; i < end; ++i) {
                uint32_t light = table.light_of_primitive[i];
                lights[i]      = light >= kOnlyHit ? light : position[light];
            }
        });
        lights[count]        = kNone;
        m_light_of_primitive = storage.close();

        if constexpr (dr::is_jit_v<Float>) {
            std::vector<uint32_t> ranges(2, 0);
            for (const auto &s : table.shapes) {
                uint32_t id = jit_registry_id(s.shape);
                if (ranges.size() < 2 * (id + 1))
                    ranges.resize(2 * (id + 1), 0);
                ranges[2 * id]     = s.first;
                ranges[2 * id + 1] = s.count;
            }
            m_shape_lights = dr::load<IndexStorage>(ranges.data(), ranges.size());
        } else {
            for (const auto &s : table.shapes)
                if (s.count)
                    m_shape_map[s.shape] = s;
        }
    }

    Tree m_tree;
    std::unique_ptr<VisibilityTable<FloatD>> m_visibility;
    Fingerprint<Float> m_learnt_shapes{ 0 };
    static constexpr uint32_t kMostRecords = 1u << 20;
    IndexStorage m_light_of_primitive, m_shape_lights;
    std::unordered_map<const Shape *, ShapeLights<Shape>> m_shape_map;
    /// See HostTable; for each emitter of the scene
    std::vector<bool> m_proportional;
    std::vector<const Emitter *> m_infinite;
    mitsuba::DynamicBuffer<EmitterPtr> m_infinite_dr;
    bool m_needs_emitter_eval = false, m_can_be_hit = false;
    /// See HostTable
    uint32_t m_only_hit = 0;
    std::string m_first_only_hit;
    Lobes m_lobes = Lobes::None;
    MediaKinds m_media;
    Statistics m_statistics;
};

} // namespace manylights

#pragma once

/**
 * The lights of one scene, ready for the kernels: table and tree in device memory, the
 * map from a hit to its light.
 */

#include "light_groups.h"
#include "manylights/base/stopwatch.h"
#include "manylights/choice/parameters.h"
#include "media_kinds.h"
#include "refit.h"
#include "scene_lobes.h"
#include "visibility_learner.h"
#include <cmath>
#include <unordered_map>

namespace manylights {

template <typename Float, typename Spectrum> class SceneLights : public mitsuba::Object {
public:
    MI_IMPORT_TYPES(Scene, Sensor, Emitter, EmitterPtr, Shape, ShapePtr)
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

    SceneLights(const Scene *scene, bool keep_binary, const GroupNames &groups) {
        // Read the emitters
        Stopwatch stopwatch;
        Table table = LightTableReader<Float, Spectrum>::read(scene);
        m_infinite  = std::move(table.infinite);
        if (!m_infinite.empty())
            m_infinite_dr = dr::load<mitsuba::DynamicBuffer<EmitterPtr>>(
                m_infinite.data(), m_infinite.size());
        m_groups             = LightGroups<Float, Spectrum>(scene, groups, m_infinite);
        m_proportional       = std::move(table.proportional);
        m_needs_emitter_eval = table.needs_emitter_eval;
        m_can_be_hit         = table.can_be_hit;
        m_tree.kinds         = table.kinds;
        m_tree.directions    = directions(table);
        m_only_hit           = table.only_hit;
        m_first_only_hit     = table.first_only_hit;
        m_tree.set_scale(table.scale);
        m_lobes            = find_lobes<Float, Spectrum>(scene);
        m_media            = MediumReader<Float, Spectrum>::find(scene);
        m_tree.light_count = (uint32_t) table.rows.size();

        // Build the tree into memory that kernels can read
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
        m_tree.node_count = dr::opaque<UInt32D>((uint32_t) tree.node_link.size());
        m_tree.binary     = or_empty(dr::load<Storage>(
            tree.binary.data(), tree.binary.size() * kBinaryNodeFloats));
        // Put rows and primitives into the order of the tree
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

    /// Follow a change of the scene's size
    void set_size(const Scene *scene) {
        // In double precision, where squares of all units fit; places without sense do not count
        double squares = 0;
        for (double extent : scene->bbox().extents())
            squares += std::isfinite(extent) ? extent * extent : 0;
        if (float diagonal = (float) std::sqrt(squares); diagonal != m_host_diagonal)
            m_diagonal = dr::opaque<FloatD>(m_host_diagonal = diagonal);
    }

    using Change = typename Fingerprint<Float>::Change;

    /// Follow a change of what some emitters emit, see \ref LightRefit; false if that is not possible:
    /// the lights are then of no use any more
    bool refit(const Scene *scene, const std::vector<Change> &changed) {
        Stopwatch stopwatch;
        LightRefit<Float, Spectrum> refit(scene, m_tree, m_statistics.nodes,
                                          m_proportional, m_light_of_primitive);
        if (!refit.run(changed))
            return false;
        m_needs_emitter_eval |= refit.needs_emitter_eval();
        m_statistics.refit_ms = stopwatch.milliseconds();
        ++m_version;
        return true;
    }

    /// How often they have changed
    uint32_t version() const { return m_version; }

    /// For integrators that trace no rays from surfaces to find lights with
    void warn_of_lights_for_rays() const {
        if (m_only_hit > 0)
            Log(mitsuba::Warn,
                "%u of the scene's emitters can only be found by rays, and are missing "
                "because \"bsdf_samples\" is 0: no point can be chosen on them, or no "
                "light "
                "was found on them. The first one belongs to \"%s\".",
                m_only_hit, m_first_only_hit);
    }

    const Tree &tree() const { return m_tree; }

    /// Which groups they belong to, if any were asked for
    const LightGroups<Float, Spectrum> &groups() const { return m_groups; }
    void set_group_levels(std::vector<uint32_t> levels) {
        m_groups.set_levels(std::move(levels));
    }

    using Learner = VisibilityLearner<Float, Spectrum>;
    /// What is learnt of the lights' visibility; after a change kernels use what it says
    const Learner &learner() const { return m_learner; }
    void start_learning(const Scene *scene, const Sensor *sensor, double samples,
                        bool keep) {
        auto camera = sensor->world_transform().translation();
        CellSize<FloatD> size{ mitsuba::Point<FloatD, 3>(plain(Point3f(camera))),
                               m_diagonal };
        m_learner.start(scene, size, m_statistics.nodes, samples, keep);
    }
    template <typename Change> void change_learner(const Change &change) {
        change(m_learner);
        m_tree.visibility = m_learner.in_use();
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
    /// Mitsuba's `timed_sunsky` looks at numbers of lanes, which recorded loops do not have
    bool evaluates_loops() const {
        bool result = false;
        if constexpr (dr::is_jit_v<Float>)
            for (const Emitter *emitter : m_infinite)
                result |= emitter->class_name() == "TimedSunskyEmitter";
        return result;
    }
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

    /// What is no array, see HostFacts
    void add_facts(Hash &facts, const SamplingParameters &params) const {
        bool all = params.considers_all(m_tree.light_count);
        for (size_t fact :
             { (size_t) all, all ? (size_t) m_tree.light_count : 0,
               (size_t) m_tree.kinds.bits, (size_t) m_tree.directions, (size_t) m_lobes,
               (size_t) m_media.bits(), (size_t) m_needs_emitter_eval,
               (size_t) m_can_be_hit, (size_t) dr::width(m_shape_lights),
               (size_t) Learner::record_count(512. * m_statistics.nodes) })
            facts.mix(fact);
        for (const Emitter *emitter : m_infinite)
            facts.mix(jit_registry_id(emitter));
        m_groups.add_facts(facts);
    }

    MI_TRAVERSE_CB(mitsuba::Object, m_tree, m_light_of_primitive, m_shape_lights,
                   m_infinite_dr, m_groups, m_diagonal)
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
    Learner m_learner;
    IndexStorage m_light_of_primitive, m_shape_lights;
    std::unordered_map<const Shape *, ShapeLights<Shape>> m_shape_map;
    /// See HostTable; for each emitter of the scene
    std::vector<bool> m_proportional;
    std::vector<const Emitter *> m_infinite;
    mitsuba::DynamicBuffer<EmitterPtr> m_infinite_dr;
    LightGroups<Float, Spectrum> m_groups;
    bool m_needs_emitter_eval = false, m_can_be_hit = false;
    /// See HostTable
    uint32_t m_only_hit = 0;
    std::string m_first_only_hit;
    Lobes m_lobes = Lobes::None;
    MediaKinds m_media;
    /// Of the scene's bounding box
    FloatD m_diagonal     = 0.f;
    float m_host_diagonal = 0.f;
    uint32_t m_version    = 0;
    Statistics m_statistics;
};

} // namespace manylights

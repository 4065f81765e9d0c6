#pragma once

/**
 * The lights of one scene, ready for the kernels: table and tree in device memory, the
 * map from a hit to its light, and a fingerprint that tells when to build it anew.
 */

#include "emission.h"
#include "light_table.h"
#include "media.h"
#include <chrono>
#include <drjit/tensor.h>
#include <mitsuba/render/bsdf.h>
#include <unordered_map>

namespace manylights {

/// Collects the identity (JIT) or the values (scalar) of an object's parameters
template <typename Float> class Fingerprint {
public:
    using Object = mitsuba::Object;

    void add(const Object *object) {
        mix((uint64_t) object);
        if constexpr (dr::is_jit_v<Float>) {
            // A changed parameter is a new variable. Holding on to them keeps the indices
            // from being used again.
            dr::scoped_set_flag guard(JitFlag::EnableObjectTraversal, true);
            object->traverse_1_cb_ro(
                this, [](void *self, uint64_t index, const char *, const char *) {
                    ((Fingerprint *) self)->hold(index);
                });
        } else {
            ValueHash callback(*this);
            const_cast<Object *>(object)->traverse(&callback);
        }
    }

    bool operator==(const Fingerprint &other) const {
        return m_hash == other.m_hash && m_held.size() == other.m_held.size();
    }

    Fingerprint()               = default;
    Fingerprint(Fingerprint &&) = default;
    Fingerprint &operator=(Fingerprint &&other) {
        std::swap(m_held, other.m_held);
        std::swap(m_hash, other.m_hash);
        return *this;
    }
    ~Fingerprint() {
        for (uint32_t index : m_held)
            jit_var_dec_ref(index);
    }

    void mix(uint64_t value) { // FNV-1a over 64-bit words
        m_hash = (m_hash ^ value) * 0x100000001b3ull;
        m_hash ^= m_hash >> 29;
    }

private:
    /// The upper half tells whether the variable has a gradient
    void hold(uint64_t combined) {
        mix(combined);
        if (uint32_t index = (uint32_t) combined) {
            jit_var_inc_ref(index);
            m_held.push_back(index);
        }
    }

    void mix_bytes(const void *data, size_t size) {
        mix(size);
        for (size_t i = 0; i < size; i += sizeof(uint64_t)) {
            uint64_t word = 0;
            std::memcpy(&word, (const char *) data + i, std::min(sizeof(word), size - i));
            mix(word);
        }
    }

    /// Mix a value if it is one of the types
    template <typename... Ts>
    void mix_plain(const void *value, const std::type_info &type) {
        ((type == typeid(Ts) ? mix_bytes(value, sizeof(Ts)) : void()), ...);
    }

    /// Mix a buffer or a tensor if its entries are of one of the types
    template <typename... Ts> void mix_buffer(void *value, const std::type_info &type) {
        auto mix_array = [&](auto *array) {
            using Value = dr::scalar_t<std::decay_t<decltype(*array)>>;
            mix_bytes(array->data(), array->size() * sizeof(Value));
        };
        ((type == typeid(dr::DynamicArray<Ts>) ? mix_array((dr::DynamicArray<Ts> *) value)
                                               : void()),
         ...);
        ((type == typeid(dr::Tensor<dr::DynamicArray<Ts>>)
              ? mix_array((dr::Tensor<dr::DynamicArray<Ts>> *) value)
              : void()),
         ...);
    }

    struct ValueHash : mitsuba::TraversalCallback {
        Fingerprint &out;
        explicit ValueHash(Fingerprint &out) : out(out) {}

        void put_value(std::string_view, void *value, uint32_t,
                       const std::type_info &type) override {
            using Core = mitsuba::CoreAliases<float>;
            out.template mix_plain<bool, float, double, int32_t, uint32_t,
                                   mitsuba::Color<float, 1>, mitsuba::Color<float, 3>,
                                   mitsuba::Point<float, 2>, mitsuba::Point<float, 3>,
                                   mitsuba::Vector<float, 2>, mitsuba::Vector<float, 3>,
                                   typename Core::AffineTransform4f>(value, type);
            out.template mix_buffer<float, uint32_t, dr::half>(value, type);
        }

        void put_object(std::string_view, Object *object, uint32_t) override {
            if (object)
                object->traverse(this);
        }
    };

    std::vector<uint32_t> m_held;
    uint64_t m_hash = 0xcbf29ce484222325ull;
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
    };

    SceneLights(const Scene *scene, bool keep_binary) {
        auto start                 = std::chrono::steady_clock::now();
        auto table                 = LightTableReader<Float, Spectrum>::read(scene);
        LightTree tree             = build_tree(table.bounds, keep_binary);
        std::vector<LightRow> rows = ordered_rows(table, tree);

        m_infinite = std::move(table.infinite);
        if (!m_infinite.empty())
            m_infinite_dr = dr::load<mitsuba::DynamicBuffer<EmitterPtr>>(
                m_infinite.data(), m_infinite.size());
        m_needs_emitter_eval = table.needs_emitter_eval;
        m_can_be_hit         = table.can_be_hit;
        for (const LightRow &row : rows)
            m_tree.kinds.insert((LightKind) (row.tag & kTagKindMask));
        m_tree.directions  = directions(table);
        m_glossy           = any_glossy(scene);
        m_media            = Media<Float, Spectrum>::find(scene);
        m_tree.light_count = (uint32_t) rows.size();
        m_tree.nodes =
            upload((const float *) tree.wide.data(), tree.wide.size() * kWideNodeFloats);
        m_tree.node_links = upload_indices(tree.node_link);
        m_tree.binary     = upload((const float *) tree.binary.data(),
                                   tree.binary.size() * kBinaryNodeFloats);
        m_tree.rows       = upload((const float *) rows.data(), rows.size() * kRowFloats);
        upload_map(table, tree);
        if constexpr (dr::is_jit_v<Float>)
            dr::eval(m_tree.nodes, m_tree.node_links, m_tree.binary, m_tree.rows,
                     m_shape_lights, m_light_of_primitive);

        m_statistics.lights         = table.light_count;
        m_statistics.lights_in_tree = m_tree.light_count;
        m_statistics.nodes          = (uint32_t) tree.wide.size();
        m_statistics.depth          = tree.depth;
        m_statistics.bytes =
            sizeof(float) *
            ((double) dr::width(m_tree.nodes) + dr::width(m_tree.node_links) +
             dr::width(m_tree.binary) + dr::width(m_tree.rows) +
             dr::width(m_light_of_primitive) + dr::width(m_shape_lights));
        m_statistics.build_ms = std::chrono::duration<float, std::milli>(
                                    std::chrono::steady_clock::now() - start)
                                    .count();
    }

    static Fingerprint<Float> fingerprint(const Scene *scene) {
        Fingerprint<Float> result;
        for (const auto &emitter : scene->emitters()) {
            result.add(emitter.get());
            result.mix(emitter->flags());
            if (const Shape *shape = emitter->shape()) {
                result.add(shape);
                result.mix(shape->has_flipped_normals());
            }
        }
        // The same emitters may belong to another scene: a new one that lies in memory
        // where a deleted one lay
        MediaKinds media = Media<Float, Spectrum>::find(scene);
        result.mix(4 * any_glossy(scene) + 2 * media.homogeneous + media.heterogeneous);
        return result;
    }

    const Tree &tree() const { return m_tree; }
    /// Has any surface a glossy lobe?
    bool glossy() const { return m_glossy; }
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
            auto it = active ? m_shape_map.find(shape) : m_shape_map.end();
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

    static bool any_glossy(const Scene *scene) {
        for (const auto &shape : scene->shapes())
            if (shape->bsdf() &&
                has_flag(shape->bsdf()->flags(), mitsuba::BSDFFlags::Glossy))
                return true;
        return false;
    }

    static std::vector<LightRow> ordered_rows(const Table &table, const LightTree &tree) {
        std::vector<LightRow> rows(table.rows.size());
        for (size_t i = 0; i < rows.size(); ++i) {
            rows[i]      = table.rows[tree.order[i]];
            rows[i].link = tree.link[i];
        }
        return rows;
    }

    static Storage upload(const float *data, size_t size) {
        // Never empty: kernels may refer to it with all lanes inactive
        return size ? dr::load<Storage>(data, size) : dr::zeros<Storage>(kWideNodeFloats);
    }

    static IndexStorage upload_indices(const std::vector<uint32_t> &data) {
        return data.empty() ? dr::zeros<IndexStorage>(1)
                            : dr::load<IndexStorage>(data.data(), data.size());
    }

    void upload_map(const Table &table, const LightTree &tree) {
        std::vector<uint32_t> position(table.rows.size());
        for (size_t i = 0; i < position.size(); ++i)
            position[tree.order[i]] = (uint32_t) i;
        std::vector<uint32_t> lights(table.light_of_primitive);
        for (uint32_t &light : lights)
            light = light >= kOnlyHit ? light : position[light];
        lights.push_back(kNone);
        m_light_of_primitive = dr::load<IndexStorage>(lights.data(), lights.size());

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
    IndexStorage m_light_of_primitive, m_shape_lights;
    std::unordered_map<const Shape *, ShapeLights<Shape>> m_shape_map;
    std::vector<const Emitter *> m_infinite;
    mitsuba::DynamicBuffer<EmitterPtr> m_infinite_dr;
    bool m_needs_emitter_eval = false, m_can_be_hit = false, m_glossy = false;
    MediaKinds m_media;
    Statistics m_statistics;
};

} // namespace manylights

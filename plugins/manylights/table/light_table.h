#pragma once

/**
 * Scene emitters -> light table: reads every emitter once, on the host.
 *
 * Points, spots and area emitters of constant radiance become rows that the kernels can
 * evaluate without a virtual call; each triangle of an emissive mesh is a light of its
 * own. Of radiance that varies, the table has the mean over the triangle, sphere, disk or
 * cylinder; the emitter evaluates it at the point that was chosen. Other emitters of finite
 * extent (projectors, exotic shapes) are one light each, sampled through their own plugin
 * after they were selected. Emitters at
 * infinity stay out of the table, and so do those without power.
 *
 * Emitters and textures are read through Mitsuba's traversal interface, since the classes
 * of its plugins have no headers.
 */

#include "light_flux.h"
#include "manylights/base/host_memory.h"
#include "mesh_emission.h"
#include "quadric_emission.h"
#include "row.h"
#include <cstring>
#include <mitsuba/core/logger.h>
#include <mitsuba/core/qmc.h>
#include <mitsuba/render/scene.h>
#include <optional>
#include <unordered_map>

namespace manylights {

namespace dr = drjit;

/// Primitives of one emissive shape -> lights: light_of_primitive[first + primitive]
template <typename Shape> struct ShapeLights {
    const Shape *shape;
    uint32_t first, count;
};

/// The table before the tree gives it its order
template <typename Float, typename Spectrum> struct HostTable {
    using Emitter = mitsuba::Emitter<Float, Spectrum>;
    using Shape   = mitsuba::Shape<Float, Spectrum>;

    HostVector<LightRow> rows;
    HostVector<LightBounds> bounds;
    KindSet kinds;
    /// Emitters without a place: environments, suns, directional lights
    std::vector<const Emitter *> infinite;
    std::vector<ShapeLights<Shape>> shapes;
    /// Index into `rows`, kOnlyHit, or kNone for a primitive that does not emit
    HostVector<uint32_t> light_of_primitive;
    /// Emitters whose emission is in proportion to that of each of their lights, of which
    /// none was left out
    std::vector<bool> proportional;
    /// Lights of any kind, those left out of the tree included
    uint32_t light_count = 0;
    /// Is there an emissive surface whose radiance is not in the table?
    bool needs_emitter_eval = false;
    /// Can a ray hit any light?
    bool can_be_hit = false;
    /// Emitters that only rays can find, and the name of the first one
    uint32_t only_hit = 0;
    std::string first_only_hit;
    /// Factor of all fluxes of `bounds`, see \ref flux_scale
    float scale = 1.f;
    /// Do narrow spots matter? The axes of all bounds are then mean directions of emission
    bool beams = false;
};

/// Spots up to this angle are narrow: wider ones resemble a cosine
constexpr float kWidestBeam = .5f;
/**
 * Narrow spots matter if they have this share of the tree's flux: where they have less, their
 * noise is small, and lobes in place of harmonics for all lights take 1.2 times the time.
 */
constexpr double kLeastBeams = .01;

template <typename Float, typename Spectrum> class LightTableReader {
public:
    MI_IMPORT_TYPES(Scene, Emitter, Shape, Mesh)
    using Table = HostTable<Float, Spectrum>;

    /// Read all emitters of a scene
    static Table read(const Scene *scene) {
        LightTableReader reader;
        reader.m_scene       = scene;
        const auto &emitters = scene->emitters();
        reader.reserve();
        for (size_t i = 0; i < emitters.size(); ++i)
            reader.add(emitters[i].get(), (uint32_t) i);
        reader.estimate_unknown_powers();
        reader.finish_bounds();
        reader.warn_of_invalid_lights();
        return std::move(reader.m_table);
    }

    /// Read one emitter alone; none if its power depends on the others
    static std::optional<Table> read_one(const Scene *scene, uint32_t emitter) {
        LightTableReader reader;
        reader.m_scene = scene;
        reader.m_table.proportional.resize(scene->emitters().size(), false);
        reader.add(scene->emitters()[emitter].get(), emitter);
        if (reader.m_unknown_powers)
            return {};
        return std::move(reader.m_table);
    }

private:
    /// Memory for as many lights as there may be: growing would need twice as much
    void reserve() {
        size_t count = 0;
        for (const auto &emitter : m_scene->emitters()) {
            const Shape *shape = emitter->shape();
            count += shape && shape->is_mesh() ? ((const Mesh *) shape)->face_count() : 1;
        }
        m_table.rows.reserve(count);
        m_table.bounds.reserve(count);
        m_table.light_of_primitive.reserve(count);
        m_table.proportional.resize(m_scene->emitters().size(), false);
    }

    /// Fluxes in units of the largest one; and where narrow spots do not matter, unit axes and
    /// the weights of spots that go with them (see LightBounds)
    void finish_bounds() {
        m_table.beams = m_beam_flux > kLeastBeams * (m_other_flux + m_beam_flux);
        m_table.scale = flux_scale(m_largest_flux > 0 ? m_largest_flux : m_infinite_flux);
        for_chunks(m_table.rows.size(), [&](size_t, size_t begin, size_t end) {
            for (size_t i = begin; i < end; ++i) {
                LightBounds &bounds = m_table.bounds[i];
                bounds.flux = scaled_flux(light_flux(m_table.rows[i], m_table.beams),
                                          m_table.scale);
                if (m_table.beams)
                    continue;
                float length = norm(bounds.axis);
                for (float &coordinate : bounds.axis)
                    coordinate /= length > 0 ? length : 1.f;
            }
        });
    }

    void add(const Emitter *emitter, uint32_t index) {
        m_emitter             = index;
        m_flags               = emitter->flags();
        bool surface          = has_flag(m_flags, mitsuba::EmitterFlags::Surface);
        bool directional      = has_flag(m_flags, mitsuba::EmitterFlags::DeltaDirection);
        std::string_view name = emitter->class_name();
        if (emitter->sampling_weight() == 0)
            add_unsampled(emitter);
        else if (surface && directional)
            ++m_table.light_count; // Mitsuba never connects to it: no contribution
        else if (surface && !emitter->shape())
            add_unattached(emitter);
        else if (surface)
            add_area(emitter, emitter->shape());
        else if (name == "PointLight")
            add_point(emitter);
        else if (name == "SpotLight")
            add_spot(emitter);
        else if (directional || has_flag(m_flags, mitsuba::EmitterFlags::Infinite)) {
            ++m_table.light_count;
            m_table.infinite.push_back(emitter);
            Emission e = EmissionReader<Float, Spectrum>::read(emitter);
            note_invalid(!is_valid(e.brightness));
            m_infinite_flux = std::max(m_infinite_flux, (double) e.brightness);
            m_table.proportional[index] = e.tabulated && e.brightness > 0;
        } else
            add_other(emitter);
    }

    static bool is_valid(double power) {
        return std::isfinite((float) power) && power >= 0;
    }

    /// Note lights of the current emitter whose power is not a finite number >= 0
    void note_invalid(uint32_t count) {
        if (count > 0 && m_invalid == 0)
            m_first_invalid = m_emitter;
        m_invalid += count;
    }

    /// What users know an emitter by
    static std::string name_of(const Emitter *emitter) {
        const Shape *shape = emitter->shape();
        return std::string(shape ? shape->id() : emitter->id());
    }

    /// Without a word they would just be missing from the image
    void warn_of_invalid_lights() const {
        if (m_invalid == 0)
            return;
        std::string id = name_of(m_scene->emitters()[m_first_invalid].get());
        Log(mitsuba::Warn,
            "Lights that are never chosen: %u of %u. Their power must not be negative, "
            "and power and position must be finite. The first one belongs to \"%s\".",
            m_invalid, m_table.light_count, id);
    }

    // ------------------------------------------------------------- Points and spots

    void add_point(const Emitter *emitter) {
        Emission e = EmissionReader<Float, Spectrum>::read(emitter);
        if (!e.tabulated)
            return add_other(emitter);
        LightRow row = make_row(LightKind::Point, e);
        // The emitter keeps its position on the host, too
        auto position = emitter->bbox().min;
        for (int i = 0; i < 3; ++i)
            row.geometry[i] = (float) position[i];
        add_light(row, point_bounds(row.geometry));
    }

    void add_spot(const Emitter *emitter) {
        ParameterReader params(emitter);
        Emission e              = EmissionReader<Float, Spectrum>::read(emitter);
        const Float *cutoff_deg = params.find<Float>("cutoff_angle"),
                    *beam_deg   = params.find<Float>("beam_width");
        float matrix[3][4];
        bool textured = has_flag(m_flags, mitsuba::EmitterFlags::SpatiallyVarying);
        if (!e.tabulated || textured || !cutoff_deg || !beam_deg ||
            !read_similarity(emitter->world_transform(), matrix))
            return add_other(emitter);

        float cutoff = dr::deg_to_rad(read_scalar(*cutoff_deg)),
              beam   = dr::deg_to_rad(read_scalar(*beam_deg));
        LightRow row = make_row(LightKind::Spot, e);
        float length = norm(matrix[0][2], matrix[1][2], matrix[2][2]);
        for (int i = 0; i < 3; ++i) {
            row.geometry[i]     = matrix[i][3];
            row.geometry[3 + i] = matrix[i][2] / length;
        }
        row.geometry[6] = cutoff;
        // Without a transition (or an inverted one) the edge is hard
        row.geometry[7] =
            cutoff > beam ? std::min(1.f / (cutoff - beam), kHardEdge) : kHardEdge;

        LightBounds bounds = point_bounds(row.geometry);
        // Uniform up to the middle of the transition
        float mean_cosine = .5f + .5f * std::cos(.5f * (std::min(beam, cutoff) + cutoff));
        for (int i = 0; i < 3; ++i)
            bounds.axis[i] = mean_cosine * row.geometry[3 + i];
        add_light(row, bounds);
    }

    /// The upper 3x4 part of a transform, if it keeps angles
    template <typename Transform>
    static bool read_similarity(const Transform &transform, float matrix[3][4]) {
        for (size_t i = 0; i < 3; ++i)
            for (size_t j = 0; j < 4; ++j)
                matrix[i][j] = read_scalar(transform.matrix.entry(i, j));
        float dots[6], scale = 0;
        const int pairs[6][2] = { { 0, 0 }, { 1, 1 }, { 2, 2 },
                                  { 0, 1 }, { 0, 2 }, { 1, 2 } };
        for (int k = 0; k < 6; ++k) {
            dots[k] = 0;
            for (int i = 0; i < 3; ++i)
                dots[k] += matrix[i][pairs[k][0]] * matrix[i][pairs[k][1]];
            scale = std::max(scale, std::abs(dots[k]));
        }
        float error =
            std::max({ std::abs(dots[0] - dots[1]), std::abs(dots[0] - dots[2]),
                       std::abs(dots[3]), std::abs(dots[4]), std::abs(dots[5]) });
        return scale > 0 && error < 1e-5f * scale;
    }

    // ---------------------------------------------------------------- Area emitters

    void add_area(const Emitter *emitter, const Shape *shape) {
        Emission e     = EmissionReader<Float, Spectrum>::read(emitter);
        uint32_t first = (uint32_t) m_table.light_of_primitive.size();
        bool known     = emitter->class_name() == "AreaLight";
        if (known && shape->is_mesh()) {
            add_mesh(emitter, (const Mesh *) shape, e);
        } else {
            std::string_view name = shape->class_name();
            uint32_t light        = (uint32_t) m_table.rows.size();
            if (known && name == "Sphere")
                add_sphere(emitter, shape, e);
            else if (known && name == "Disk")
                add_disk(emitter, shape, e);
            else if (known && name == "Cylinder")
                add_cylinder(emitter, shape, e);
            else
                add_other(emitter);
            push_primitive(light);
        }
        uint32_t count = (uint32_t) m_table.light_of_primitive.size() - first;
        m_table.shapes.push_back({ shape, first, count });
    }

    /// Object-to-world matrix of a quadric
    static void read_to_world(const Shape *shape, float m[3][4]) {
        using Transform = typename mitsuba::CoreAliases<Float>::AffineTransform4f;
        ParameterReader params(shape);
        const Transform *to_world = params.find<Transform>("to_world");
        if (!to_world)
            throw std::runtime_error("manylights: the shape \"" +
                                     std::string(shape->id()) +
                                     "\" does not expose its \"to_world\"");
        for (size_t i = 0; i < 3; ++i)
            for (size_t j = 0; j < 4; ++j)
                m[i][j] = read_scalar(to_world->matrix.entry(i, j));
    }

    static float column_length(const float m[3][4], int j) {
        return norm(m[0][j], m[1][j], m[2][j]);
    }

    static float determinant(const float m[3][4]) {
        return m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1]) -
               m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0]) +
               m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0]);
    }

    /// The bitmap that makes an emitter shine, read at first use; null if it is something else
    const TextureImage<Float, Spectrum> *shown_image(const Emitter *emitter) {
        const mitsuba::Object *radiance = ParameterReader(emitter).object("radiance");
        auto [entry, added]             = m_images.try_emplace(radiance);
        if (added)
            entry->second = TextureImage<Float, Spectrum>::read(radiance);
        return entry->second.get();
    }

    /// A sphere, disk or cylinder; its emission is not in the row if it varies
    LightRow make_quadric(LightKind kind, const Emitter *emitter, const Shape *shape,
                          Emission e, const float (&to_world)[3][4]) {
        if (!e.constant)
            e.brightness =
                QuadricEmission<Float, Spectrum>(emitter, shape, kind, to_world)
                    .brightness(shown_image(emitter));
        LightRow row = make_row(kind, e);
        if (!e.tabulated)
            set_primitive(row, 0, false);
        return row;
    }

    void add_sphere(const Emitter *emitter, const Shape *shape, const Emission &e) {
        float m[3][4];
        read_to_world(shape, m);
        LightRow row = make_quadric(LightKind::Sphere, emitter, shape, e, m);
        float radius = column_length(m, 0);
        for (int i = 0; i < 3; ++i)
            row.geometry[i] = m[i][3];
        row.geometry[3] = radius;
        row.geometry[4] = shape->has_flipped_normals() ? -1.f : 1.f;

        LightBounds bounds = point_bounds(row.geometry);
        grow(bounds, radius);
        bounds.variance = radius * radius / 3;
        add_light(row, bounds);
    }

    void add_disk(const Emitter *emitter, const Shape *shape, const Emission &e) {
        float m[3][4];
        read_to_world(shape, m);
        // A mirrored disk keeps its normal: swap the axes instead
        int u        = determinant(m) < 0 ? 1 : 0;
        LightRow row = make_quadric(LightKind::Disk, emitter, shape, e, m);
        if (!e.tabulated)
            set_primitive(row, 0, u == 1);
        for (int i = 0; i < 3; ++i) {
            row.geometry[i]     = m[i][3];
            row.geometry[3 + i] = m[i][u];
            row.geometry[6 + i] = m[i][1 - u];
        }
        LightBounds bounds = point_bounds(row.geometry);
        set_axis(bounds, row.geometry + 3, row.geometry + 6);
        float radius = std::max(column_length(m, 0), column_length(m, 1));
        grow(bounds, radius);
        bounds.variance = radius * radius / 6;
        add_light(row, bounds);
    }

    /// Is a cylinder, whose rays hit what its matrix says, a circular and upright one?
    static bool is_round(const float m[3][4]) {
        auto dot = [&](int i, int j) {
            return m[0][i] * m[0][j] + m[1][i] * m[1][j] + m[2][i] * m[2][j];
        };
        constexpr float tolerance = 1e-3f;
        float square = dot(0, 0), along = std::sqrt(square * dot(2, 2));
        return std::abs(dot(1, 1) - square) <= tolerance * square &&
               std::abs(dot(0, 1)) <= tolerance * square &&
               std::max(std::abs(dot(0, 2)), std::abs(dot(1, 2))) <= tolerance * along;
    }

    void add_cylinder(const Emitter *emitter, const Shape *shape, const Emission &e) {
        float m[3][4];
        read_to_world(shape, m);
        if (!is_round(m)) // Mitsuba warns of it
            return add_only_hit();
        LightRow row = make_quadric(LightKind::Cylinder, emitter, shape, e, m);
        float radius = column_length(m, 0), length = column_length(m, 2), center[3];
        for (int i = 0; i < 3; ++i) {
            row.geometry[i]     = m[i][3];
            row.geometry[3 + i] = m[i][2];
            center[i]           = m[i][3] + .5f * m[i][2];
        }
        row.geometry[6] = radius;
        // A mirror turns normals over once, and Mitsuba's mark of it once more
        bool inwards    = shape->has_flipped_normals() != (determinant(m) < 0);
        row.geometry[7] = inwards ? -1.f : 1.f;

        LightBounds bounds = point_bounds(center);
        for (int i = 0; i < 3; ++i) {
            bounds.box_min[i] = std::min(m[i][3], m[i][3] + m[i][2]);
            bounds.box_max[i] = std::max(m[i][3], m[i][3] + m[i][2]);
        }
        grow(bounds, radius);
        bounds.variance = (length * length / 12 + radius * radius) / 3;
        add_light(row, bounds);
    }

    // ----------------------------------------------------------------------- Meshes

    void add_mesh(const Emitter *emitter, const Mesh *mesh, const Emission &constant) {
        HostView vertices(mesh->vertex_positions_buffer());
        HostView normals(mesh->vertex_normals_buffer());
        HostView faces(mesh->faces_buffer());
        std::vector<Emission> varying;
        if (!constant.constant)
            varying =
                MeshEmission<Float, Spectrum>(emitter, mesh, shown_image(emitter)).read();
        bool flipped  = mesh->has_flipped_normals(),
             attached = emission_has_gradient<Float>(emitter, mesh);
        add_triangles(
            faces.size() / 3, [&](size_t f, LightRow &row, LightBounds &bounds) {
                const uint32_t *face = &faces[3 * f];
                Side side = emitting_side(vertices.data(), normals.data(), face);
                if (flipped && side != Side::Both)
                    side = side == Side::Front ? Side::Back : Side::Front;
                Emission e = varying.empty() ? constant : varying[f];
                e.tabulated &= !attached;
                read_triangle(vertices.data(), face, e, (uint32_t) f, side, row, bounds);
            });
        if (!constant.constant)
            m_table.proportional[m_emitter] = false;
    }

    /// What became of the triangles of one chunk
    struct Part {
        uint32_t kept = 0, invalid = 0;
        bool by_plugin = false;
        double flux = 0, largest = 0;
    };

    /// Add `count` lights, each read by `read(index, row, bounds)`, on all threads
    template <typename F> void add_triangles(size_t count, const F &read) {
        size_t first = m_table.rows.size(), primitive = m_table.light_of_primitive.size();
        m_table.rows.resize(first + count);
        m_table.bounds.resize(first + count);
        m_table.light_of_primitive.resize(primitive + count);
        std::vector<Part> parts(chunk_count(count));
        for_chunks(count, [&](size_t chunk, size_t begin, size_t end) {
            Part part;
            for (size_t i = begin; i < end; ++i) {
                size_t light        = first + begin + part.kept;
                LightRow &row       = m_table.rows[light];
                LightBounds &bounds = m_table.bounds[light];
                read(i, row, bounds);
                double power   = usable_power(row, bounds);
                bool kept      = is_valid(power) && power > 0,
                     by_plugin = !(row.tag & kTagTabulated);
                part.invalid += !is_valid(power);
                part.flux += kept ? power : 0;
                part.largest = std::max(part.largest, kept ? power : 0);
                part.by_plugin |= by_plugin;
                m_table.light_of_primitive[primitive + i] =
                    kept ? (uint32_t) light : (by_plugin ? kOnlyHit : kNone);
                part.kept += kept;
            }
            parts[chunk] = part;
        });
        close_gaps(parts, first, primitive, count);
        m_table.light_count += (uint32_t) count;
        m_table.can_be_hit |= count > 0;
        if (m_table.rows.size() > first)
            m_table.kinds.insert(LightKind::Triangle);
        m_table.proportional[m_emitter] = m_table.rows.size() == first + count;
        bool by_plugin                  = false;
        for (const Part &part : parts) {
            by_plugin |= part.by_plugin;
            m_other_flux += part.flux;
            m_largest_flux = std::max(m_largest_flux, part.largest);
            note_invalid(part.invalid);
        }
        m_table.needs_emitter_eval |= by_plugin;
        if (by_plugin && m_table.rows.size() == first)
            note_only_hit();
    }

    /// Move the lights of all chunks together
    void close_gaps(const std::vector<Part> &parts, size_t first, size_t primitive,
                    size_t count) {
        size_t end = first;
        for (size_t chunk = 0; chunk < parts.size(); ++chunk) {
            size_t begin = first + chunk * kChunk, kept = parts[chunk].kept;
            if (end < begin) {
                std::copy_n(&m_table.rows[begin], kept, &m_table.rows[end]);
                std::copy_n(&m_table.bounds[begin], kept, &m_table.bounds[end]);
                for (size_t i = chunk * kChunk; i < std::min(count, (chunk + 1) * kChunk);
                     ++i) {
                    uint32_t &light = m_table.light_of_primitive[primitive + i];
                    if (light < kOnlyHit)
                        light -= (uint32_t) (begin - end);
                }
            }
            end += kept;
        }
        m_table.rows.resize(end);
        m_table.bounds.resize(end);
    }

    /// The side of a triangle, by its winding, on which it emits: that of the shading normal
    enum class Side { Front, Back, Both };

    static Side emitting_side(const float *vertices, const float *normals,
                              const uint32_t *face) {
        if (!normals)
            return Side::Front;
        auto corner = [&](const float *buffer, int i) {
            const float *v = buffer + 3 * (size_t) face[i];
            return mitsuba::Vector<float, 3>(v[0], v[1], v[2]);
        };
        auto v0 = corner(vertices, 0);
        auto n =
            dr::normalize(dr::cross(corner(vertices, 1) - v0, corner(vertices, 2) - v0));
        float low = 1, high = -1;
        for (int i = 0; i < 3; ++i) {
            float cosine = dr::dot(n, dr::normalize(corner(normals, i)));
            low          = std::min(low, cosine);
            high         = std::max(high, cosine);
        }
        constexpr float flat = .999999f; // a tenth of a degree
        return low > flat ? Side::Front : (high < -flat ? Side::Back : Side::Both);
    }

    void read_triangle(const float *vertices, const uint32_t *face, Emission e,
                       uint32_t face_index, Side side, LightRow &row,
                       LightBounds &bounds) const {
        // With smooth normals only the emitter knows where it emits
        e.tabulated &= side != Side::Both;
        bool flip       = side == Side::Back;
        row             = make_row(LightKind::Triangle, e);
        const float *v0 = vertices + 3 * (size_t) face[0],
                    *v1 = vertices + 3 * (size_t) face[flip ? 2 : 1],
                    *v2 = vertices + 3 * (size_t) face[flip ? 1 : 2];
        double square   = 0;
        for (int i = 0; i < 3; ++i) {
            row.geometry[i]     = v0[i];
            row.geometry[3 + i] = v1[i] - v0[i];
            row.geometry[6 + i] = v2[i] - v0[i];
            bounds.box_min[i]   = std::min({ v0[i], v1[i], v2[i] });
            bounds.box_max[i]   = std::max({ v0[i], v1[i], v2[i] });
            double mean         = ((double) v0[i] + v1[i] + v2[i]) / 3;
            bounds.mean[i]      = (float) mean;
            square += (v0[i] - mean) * (v0[i] - mean) + (v1[i] - mean) * (v1[i] - mean) +
                      (v2[i] - mean) * (v2[i] - mean);
        }
        bounds.variance = (float) (square / 36); // of a uniform point; trace / 3
        set_axis(bounds, row.geometry + 3, row.geometry + 6);
        if (side == Side::Both) {
            row.tag |= kTagTwoSided;
            std::fill_n(bounds.axis, 3, 0.f);
        }
        if (!e.tabulated)
            set_primitive(row, face_index, flip);
    }

    /// For lights that their emitter evaluates: which primitive, and are its edges swapped?
    static void set_primitive(LightRow &row, uint32_t index, bool swapped) {
        std::memcpy(&row.color[0], &index, sizeof(float));
        row.color[1] = swapped ? 1.f : 0.f;
    }

    // --------------------------------------------------------------- Anything else

    /// Mitsuba's sampling never chooses an emitter of weight 0, so that rays alone find it
    void add_unsampled(const Emitter *emitter) {
        ++m_table.light_count;
        if (!has_flag(m_flags, mitsuba::EmitterFlags::Surface))
            return;
        m_table.needs_emitter_eval = m_table.can_be_hit = true;
        push_only_hit(emitter);
    }

    /// All primitives of an emitter's shape
    void push_only_hit(const Emitter *emitter) {
        uint32_t first = (uint32_t) m_table.light_of_primitive.size();
        m_table.light_of_primitive.push_back(kOnlyHit);
        if (emitter->shape())
            return m_table.shapes.push_back({ emitter->shape(), first, 1 });
        for (const auto &shape : m_scene->shapes())
            if (shape->emitter() == emitter)
                m_table.shapes.push_back({ shape.get(), first, 1 });
    }

    /// One light for the whole emitter, sampled by its plugin
    void add_other(const Emitter *emitter) {
        ScalarPoint3f low, high;
        if (!can_sample(emitter))
            return add_only_hit();
        if (!find_bounds(emitter, low, high)) {
            if (has_flag(m_flags, mitsuba::EmitterFlags::Surface))
                return add_only_hit();
            // Without a place it cannot be in the tree: always a candidate
            ++m_table.light_count;
            m_table.infinite.push_back(emitter);
            return;
        }
        float power = emitted_power(emitter);
        bool known  = power > 0;
        m_unknown_powers |= !known;
        Emission e;
        e.brightness       = known ? power / (4 * kPi) : kUnknownPower;
        LightRow row       = make_row(LightKind::Other, e);
        LightBounds bounds = {};
        double square      = 0;
        for (int i = 0; i < 3; ++i) {
            bounds.box_min[i] = (float) low[i];
            bounds.box_max[i] = (float) high[i];
            bounds.mean[i]    = .5f * ((float) low[i] + (float) high[i]);
            double extent     = (double) high[i] - low[i];
            square += extent * extent / 12;
        }
        bounds.variance = (float) (square / 3);
        std::copy_n(bounds.mean, 3, row.geometry);
        row.geometry[3] = bounds.variance;
        add_light(row, bounds);
    }

    /// Give lights of unknown power the mean of the others, which is right in any unit
    void estimate_unknown_powers() {
        if (!m_unknown_powers)
            return;
        size_t known = 0;
        for (const LightRow &row : m_table.rows)
            known += row.brightness != kUnknownPower;
        double mean    = known ? (m_beam_flux + m_other_flux) / (double) known : 1.;
        m_largest_flux = std::max(m_largest_flux, mean);
        for (LightRow &row : m_table.rows)
            if (row.brightness == kUnknownPower)
                row.brightness = (float) (mean / (4 * kPi));
        // It depends on all the others
        m_table.proportional.assign(m_table.proportional.size(), false);
    }

    /// Some shapes (ellipsoidsmesh) do not tell their emitter about themselves
    void add_unattached(const Emitter *emitter) {
        add_only_hit();
        m_only_hit = false;
        push_only_hit(emitter);
    }

    /// Note that no point is ever chosen on the current emitter
    void note_only_hit() {
        if (m_table.only_hit++ == 0)
            m_table.first_only_hit = name_of(m_scene->emitters()[m_emitter].get());
    }

    /// Count a light that only rays can find
    void add_only_hit() {
        note_only_hit();
        ++m_table.light_count;
        m_table.needs_emitter_eval = m_table.can_be_hit = true;
        m_only_hit                                      = true;
    }

    /// Some shapes of Mitsuba (curves) have no way to choose a point on them
    bool can_sample(const Emitter *emitter) const {
        try {
            SurfaceInteraction3f si = dr::zeros<SurfaceInteraction3f>();
            auto [ds, weight]       = emitter->sample_direction(si, Point2f(.5f), true);
            (void) ds;
            (void) weight;
            return true;
        } catch (const std::exception &e) {
            if (has_flag(m_flags, mitsuba::EmitterFlags::Surface))
                return false;
            throw std::runtime_error("manylights: the emitter \"" + name_of(emitter) +
                                     "\" cannot be sampled: " + e.what());
        }
    }

    bool find_bounds(const Emitter *emitter, ScalarPoint3f &low,
                     ScalarPoint3f &high) const {
        decltype(emitter->bbox()) box;
        try {
            box = emitter->shape() ? emitter->shape()->bbox() : emitter->bbox();
        } catch (const std::exception &) { // written in Python, without one
            return false;
        }
        low        = box.min;
        high       = box.max;
        bool delta = has_flag(m_flags, mitsuba::EmitterFlags::DeltaPosition);
        if (!box.valid() && delta) { // projectors have no box, only a transformation
            auto position = emitter->world_transform().translation();
            for (int i = 0; i < 3; ++i)
                low[i] = high[i] = read_scalar(position.entry(i));
        }
        return dr::all(dr::isfinite(low) && dr::isfinite(high) && low <= high);
    }

    /// Mean weight of rays that the emitter sends out; 0 if that is not known: it may not be
    /// able to send any, or a narrow beam was missed
    static float emitted_power(const Emitter *emitter) {
        MI_IMPORT_CORE_TYPES()
        constexpr uint32_t count = 1024;
        float power              = 0;
        try {
            auto weight = [&](const auto &i) {
                using UInt = std::decay_t<decltype(i)>;
                Float a    = Float(mitsuba::radical_inverse_2(UInt(i), UInt(0)));
                Point2f u((Float(i) + .5f) / (float) count, a);
                Point2f v(a, dr::fmadd(Float(i), .6180339887f, 0.f));
                v.y() -= dr::floor(v.y());
                auto [ray, spectrum] = emitter->sample_ray(0.f, .5f, u, v, true);
                (void) ray;
                return dr::mean(mitsuba::unpolarized_spectrum(spectrum));
            };
            if constexpr (dr::is_jit_v<Float>) {
                power = read_scalar(dr::mean(weight(dr::arange<UInt32>(count)) +
                                             dr::zeros<Float>(count)));
            } else {
                for (uint32_t i = 0; i < count; ++i)
                    power += weight(i) / count;
            }
            if constexpr (mitsuba::is_spectral_v<Spectrum>)
                power /= MI_CIE_MAX - MI_CIE_MIN;
        } catch (const std::exception &) {
        }
        return std::isfinite(power) ? power : 0.f;
    }

    // ----------------------------------------------------------------- Common parts

    /// The primitive is the light that was added since, if any
    void push_primitive(uint32_t next_light) {
        bool added = m_table.rows.size() > next_light;
        m_table.light_of_primitive.push_back(added ? next_light
                                                   : (m_only_hit ? kOnlyHit : kNone));
        m_only_hit = false;
    }

    LightRow make_row(LightKind kind, const Emission &e) const {
        LightRow row{};
        std::copy_n(e.color, 3, row.color);
        row.brightness = e.brightness;
        row.scale      = e.scale;
        row.tag        = make_tag(kind, e.tabulated, m_emitter);
        return row;
    }

    static LightBounds point_bounds(const float position[3]) {
        LightBounds bounds{};
        std::copy_n(position, 3, bounds.box_min);
        std::copy_n(position, 3, bounds.box_max);
        std::copy_n(position, 3, bounds.mean);
        return bounds;
    }

    static void grow(LightBounds &bounds, float radius) {
        for (int i = 0; i < 3; ++i) {
            bounds.box_min[i] -= radius;
            bounds.box_max[i] += radius;
        }
    }

    /// Set the emission axis to the direction of u x v
    static void set_axis(LightBounds &bounds, const float u[3], const float v[3]) {
        float n[3];
        cross(u, v, n);
        float length                = norm(n);
        constexpr float mean_cosine = 2.f / 3.f;
        for (int i = 0; i < 3; ++i)
            bounds.axis[i] = length > 0 ? mean_cosine * n[i] / length : 0;
    }

    /// Power that decides whether a light can be chosen; infinite without a finite place
    static double usable_power(const LightRow &row, const LightBounds &bounds) {
        double power = light_power(row);
        bool finite  = std::isfinite(power) && std::isfinite(bounds.variance);
        for (int i = 0; i < 3; ++i)
            finite &=
                std::isfinite(bounds.box_min[i]) && std::isfinite(bounds.box_max[i]);
        return finite ? power : dr::Infinity<double>;
    }

    /// Lights without power, and degenerate ones, stay out
    void add_light(const LightRow &row, const LightBounds &bounds) {
        ++m_table.light_count;
        LightKind kind = (LightKind) (row.tag & kTagKindMask);
        bool hit_able  = has_flag(m_flags, mitsuba::EmitterFlags::Surface);
        bool by_plugin = hit_able && !(row.tag & kTagTabulated);
        m_table.needs_emitter_eval |= by_plugin;
        m_table.can_be_hit |= hit_able;
        double power = usable_power(row, bounds);
        note_invalid(!is_valid(power));
        if (!is_valid(power) || power == 0) {
            m_only_hit = by_plugin; // black as far as the quadrature saw
            if (by_plugin)
                note_only_hit();
            return;
        }
        m_table.proportional[m_emitter] =
            kind != LightKind::Other && (row.tag & kTagTabulated);
        bool beam   = kind == LightKind::Spot && row.geometry[6] < kWidestBeam,
             known  = row.brightness != kUnknownPower;
        double flux = known ? light_flux(row, /* beams = */ false) : 0;
        (beam ? m_beam_flux : m_other_flux) += flux;
        m_largest_flux = std::max(m_largest_flux, flux);
        m_table.kinds.insert(kind);
        m_table.rows.push_back(row);
        m_table.bounds.push_back(bounds);
    }

    /// Stands for a power that could not be found, and is too small to count
    static constexpr float kUnknownPower = std::numeric_limits<float>::min();

    const Scene *m_scene = nullptr;
    Table m_table;
    /// Bitmaps that emit, by their texture; null for other textures
    std::unordered_map<const mitsuba::Object *,
                       std::unique_ptr<TextureImage<Float, Spectrum>>>
        m_images;
    /// Index of the emitter that is being read; did its last light turn out to be unsampled?
    uint32_t m_emitter = 0;
    bool m_only_hit    = false;
    /// Flags of that emitter: asking for them makes a variable in JIT variants
    uint32_t m_flags = 0;
    /// Is there a light with \ref kUnknownPower?
    bool m_unknown_powers = false;
    /// Sums of the fluxes of narrow spots and of all else, the largest of all, and the largest
    /// irradiance or radiance of lights without a place
    double m_beam_flux = 0, m_other_flux = 0, m_largest_flux = 0, m_infinite_flux = 0;
    /// Lights that \ref note_invalid noted, and the index of the first one's emitter
    uint32_t m_invalid = 0, m_first_invalid = 0;

    static constexpr const char *ClassName = "LightTable"; // for log messages
};

} // namespace manylights

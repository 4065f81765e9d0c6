#pragma once

/**
 * Readers of area emitters on spheres, disks and cylinders.
 */

#include "quadric_emission.h"
#include "table_builder.h"

namespace manylights {

template <typename Float, typename Spectrum> class Quadrics {
public:
    MI_IMPORT_TYPES(Emitter, Shape)
    using Builder = TableBuilder<Float, Spectrum>;
    using Images  = ShownImages<Float, Spectrum>;

    Quadrics(Builder &builder, Images &images) : m_builder(builder), m_images(images) {}

    /// False if the shape is none of these; `e`: what was read of the emission
    bool add(const Emitter *emitter, const Shape *shape, const Emission &e) {
        std::string_view name = shape->class_name();
        if (name == "Sphere")
            add_sphere(emitter, shape, e);
        else if (name == "Disk")
            add_disk(emitter, shape, e);
        else if (name == "Cylinder")
            add_cylinder(emitter, shape, e);
        else
            return false;
        return true;
    }

private:
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

    /// A sphere, disk or cylinder; its emission is not in the row if it varies
    LightRow make_quadric(LightKind kind, const Emitter *emitter, const Shape *shape,
                          Emission e, const float (&to_world)[3][4]) {
        if (!e.constant)
            e.brightness =
                QuadricEmission<Float, Spectrum>(emitter, shape, kind, to_world)
                    .brightness(m_images.of(emitter));
        LightRow row = m_builder.make_row(kind, e);
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
        m_builder.add_light(row, bounds);
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
        m_builder.add_light(row, bounds);
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
            return m_builder.add_only_hit();
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
        m_builder.add_light(row, bounds);
    }

    Builder &m_builder;
    Images &m_images;
};

} // namespace manylights

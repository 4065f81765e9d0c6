#pragma once

/**
 * Reader of area emitters on meshes: each triangle is a light of its own.
 */

#include "mesh_emission.h"
#include "table_builder.h"

namespace manylights {

template <typename Float, typename Spectrum> class MeshLights {
public:
    MI_IMPORT_TYPES(Emitter, Mesh)
    using Builder = TableBuilder<Float, Spectrum>;
    using Images  = ShownImages<Float, Spectrum>;

    MeshLights(Builder &builder, Images &images) : m_builder(builder), m_images(images) {}

    /// `constant`: what was read of the emission, if it is the same everywhere
    void add(const Emitter *emitter, const Mesh *mesh, const Emission &constant) {
        HostView vertices(mesh->vertex_positions_buffer());
        HostView normals(mesh->vertex_normals_buffer());
        HostView faces(mesh->faces_buffer());
        std::vector<Emission> varying;
        if (!constant.constant)
            varying =
                MeshEmission<Float, Spectrum>(emitter, mesh, m_images.of(emitter)).read();
        bool flipped  = mesh->has_flipped_normals(),
             attached = emission_has_gradient<Float>(emitter, mesh);
        m_builder.add_triangles(
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
            m_builder.set_not_proportional();
    }

private:
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
        row             = m_builder.make_row(LightKind::Triangle, e);
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

    Builder &m_builder;
    Images &m_images;
};

} // namespace manylights

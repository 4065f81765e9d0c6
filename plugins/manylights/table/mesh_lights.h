#pragma once

/**
 * Reader of area emitters on meshes: each triangle is a light of its own.
 */

#include "manylights/emission/mesh_emission.h"
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
                Side side =
                    TriangleLight::emitting_side(vertices.data(), normals.data(), face);
                if (flipped && side != Side::Both)
                    side = side == Side::Front ? Side::Back : Side::Front;
                Emission e = varying.empty() ? constant : varying[f];
                e.tabulated &= !attached;
                TriangleLight::read(vertices.data(), face, (uint32_t) f, side, e, row,
                                    bounds);
            });
        if (!constant.constant)
            m_builder.set_not_proportional();
    }

private:
    using Side = TriangleLight::Side;

    Builder &m_builder;
    Images &m_images;
};

} // namespace manylights

#pragma once

/**
 * Mean emission of each face of an emissive mesh whose radiance varies: mesh attributes from
 * the corners, bitmaps from the map of their texels, all else from points on the faces, a
 * bounded number for each mesh.
 *
 * Each face is one light. Which point of it is chosen does not depend on the texture, which
 * may vary a lot within a large face.
 */

#include "surface_emission.h"
#include "texture_image.h"
#include <mitsuba/render/mesh.h>

namespace manylights {

template <typename Float, typename Spectrum> class MeshEmission {
public:
    MI_IMPORT_TYPES(Emitter, Mesh)
    using Image = TextureImage<Float, Spectrum>;

    /// `image`: the bitmap that the mesh shows, if it is one
    MeshEmission(const Emitter *emitter, const Mesh *mesh, const Image *image)
        : m_surface(emitter, mesh), m_mesh(mesh), m_image(image) {}

    /// Mean emission of each face
    std::vector<Emission> read() const {
        std::vector<Emission> result(m_mesh->face_count());
        const mitsuba::Object *texture = m_surface.radiance();
        if (texture && texture->class_name() == "MeshAttribute")
            read_attribute(result);
        else if (m_image)
            read_image(result);
        else if (m_surface.varies())
            look_at_faces(result);
        else
            look_at_mesh(result);
        return result;
    }

private:
    using Reader  = EmissionReader<Float, Spectrum>;
    using Surface = SurfaceEmission<Float, Spectrum>;
    using Points  = typename Surface::Points;
    using Color3  = typename Surface::Color3;

    /// Attributes are linear over a face: their mean is that of the corners
    void read_attribute(std::vector<Emission> &result) const {
        size_t count = result.size();
        std::vector<Color3> corner[3];
        for (int c = 0; c < 3; ++c) { // just inside of the corners
            Points points(count);
            for (size_t i = 0; i < count; ++i) {
                points.primitive[i] = (uint32_t) i;
                points.u[i]         = c == 1 ? .9f : .05f;
                points.v[i]         = c == 2 ? .9f : .05f;
            }
            corner[c] = m_surface.evaluate(points);
        }
        for (size_t i = 0; i < count; ++i) {
            Emission &e   = result[i];
            bool constant = corner[0][i] == corner[1][i] && corner[0][i] == corner[2][i];
            for (int c = 0; c < 3; ++c)
                e.color[c] =
                    constant ? corner[0][i][c]
                             : (corner[0][i][c] + corner[1][i][c] + corner[2][i][c]) / 3;
            e.brightness = Reader::brightness(e.color);
            // A spectrum cannot be recovered from its mean
            e.tabulated = constant && !mitsuba::is_spectral_v<Spectrum>;
        }
    }

    void read_image(std::vector<Emission> &result) const {
        HostView faces(m_mesh->faces_buffer());
        HostView texcoords(m_mesh->vertex_texcoords_buffer());
        bool has_texcoords = m_mesh->has_vertex_texcoords();
        for_chunks(result.size(), [&](size_t, size_t begin, size_t end) {
            for (size_t f = begin; f < end; ++f) {
                Point2 uv[3] = { { 0, 0 }, { 1, 0 }, { 0, 1 } };
                for (int i = 0; has_texcoords && i < 3; ++i)
                    for (int k = 0; k < 2; ++k)
                        uv[i][k] = texcoords[2 * (size_t) faces[3 * f + i] + k];
                result[f].brightness = m_image->mean(uv, 3);
            }
        });
    }

    /// Mean brightness of even points of the faces face(0), face(1), ...
    template <typename F>
    std::vector<float> look(size_t faces, size_t per_face, const F &face) const {
        Points points(faces * per_face);
        for (size_t i = 0; i < points.size(); ++i) {
            size_t f            = face(i / per_face);
            Point2 b            = even_point(i % per_face, f);
            bool outside        = b[0] + b[1] > 1;
            points.primitive[i] = (uint32_t) f;
            points.u[i]         = (float) (outside ? 1 - b[0] : b[0]);
            points.v[i]         = (float) (outside ? 1 - b[1] : b[1]);
        }
        std::vector<float> brightness = m_surface.brightness(points), result(faces);
        for (size_t f = 0; f < faces; ++f)
            result[f] = mean_of(&brightness[f * per_face], per_face);
        return result;
    }

    /**
     * The mean over points of each face. A part of the mean over the mesh is added: what shines
     * between the points of a face must not be lost.
     */
    void look_at_faces(std::vector<Emission> &result) const {
        constexpr size_t budget = 1 << 14, least = 4, most = 1 << 10, batch = 1 << 20;
        constexpr float mesh_part = 1.f / 32;
        size_t count              = result.size(),
               per_face = std::clamp(budget / std::max<size_t>(count, 1), least, most);
        double sum      = 0;
        for (size_t begin = 0; begin < count; begin += batch / per_face) {
            size_t faces = std::min(count - begin, batch / per_face);
            std::vector<float> means =
                look(faces, per_face, [&](size_t i) { return begin + i; });
            for (size_t i = 0; i < faces; ++i) {
                result[begin + i].brightness = means[i];
                sum += std::isfinite(means[i]) && means[i] > 0 ? means[i] : 0;
            }
        }
        float added = mesh_part * (float) (sum / (double) count);
        for (Emission &e : result)
            e.brightness += e.brightness >= 0 ? added : 0;
    }

    /// One mean for all faces
    void look_at_mesh(std::vector<Emission> &result) const {
        size_t faces = std::min<size_t>(result.size(), 16);
        if (faces == 0)
            return;
        std::vector<float> values =
            look(faces, 1, [&](size_t i) { return i * result.size() / faces; });
        for (Emission &e : result)
            e.brightness = mean_of(values.data(), faces);
    }

    Surface m_surface;
    const Mesh *m_mesh;
    const Image *m_image;
};

} // namespace manylights

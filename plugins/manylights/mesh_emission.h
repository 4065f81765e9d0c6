#pragma once

/**
 * Mean emission of each face of an emissive mesh whose radiance varies: mesh attributes
 * from the corners, textures by quadrature at the density of their texels.
 */

#include "emission_reader.h"
#include <array>
#include <mitsuba/render/emitter.h>
#include <mitsuba/render/mesh.h>
#include <mitsuba/render/texture.h>

namespace manylights {

template <typename Float, typename Spectrum> class MeshEmission {
public:
    MI_IMPORT_TYPES(Emitter, Mesh, Texture)

    MeshEmission(const Emitter *emitter, const Mesh *mesh)
        : m_emitter(emitter), m_mesh(mesh) {}

    /// Mean emission of each face
    std::vector<Emission> read() const {
        std::vector<Emission> result(m_mesh->face_count());
        const mitsuba::Object *texture = ParameterReader(m_emitter).object("radiance");
        if (texture && texture->class_name() == "MeshAttribute")
            read_attribute(result);
        else
            integrate_texture(texture, result);
        return result;
    }

private:
    using Reader = EmissionReader<Float, Spectrum>;
    using Color3 = std::array<float, 3>;

    /// Colours at points given by face and barycentric coordinates
    std::vector<Color3> evaluate(const std::vector<uint32_t> &faces,
                                 const std::vector<float> &b1,
                                 const std::vector<float> &b2) const {
        size_t count = faces.size();
        std::vector<Color3> result(count);
        if constexpr (dr::is_jit_v<Float>) {
            Color3fOf<Float> color = evaluate_color(
                dr::load<dr::uint32_array_t<Float>>(faces.data(), count),
                dr::load<Float>(b1.data(), count), dr::load<Float>(b2.data(), count));
            for (int c = 0; c < 3; ++c) {
                color.entry(c) += dr::zeros<Float>(count);
                HostView host(color.entry(c));
                for (size_t i = 0; i < count; ++i)
                    result[i][c] = (float) host[i];
            }
        } else {
            for (size_t i = 0; i < count; ++i) {
                auto color = evaluate_color(faces[i], b1[i], b2[i]);
                result[i]  = { color[0], color[1], color[2] };
            }
        }
        return result;
    }

    template <typename F> using Color3fOf = mitsuba::Color<F, 3>;

    /// Emitted colour along the normal; three copies of the mean of a spectrum
    Color3fOf<Float> evaluate_color(const dr::uint32_array_t<Float> &face,
                                    const Float &b1, const Float &b2) const {
        PreliminaryIntersection3f pi = dr::zeros<PreliminaryIntersection3f>();
        pi.t                         = 1.f;
        pi.prim_uv                   = { b1, b2 };
        pi.prim_index                = face;
        pi.shape                     = m_mesh;
        Ray3f ray                    = dr::zeros<Ray3f>();
        SurfaceInteraction3f si      = m_mesh->compute_surface_interaction(
            ray, pi, +mitsuba::RayFlags::All, 0, true);
        si.shape      = m_mesh;
        si.prim_index = face;
        si.wi         = { 0.f, 0.f, 1.f };
        if constexpr (mitsuba::is_spectral_v<Spectrum>)
            return Color3fOf<Float>(spectral_mean(si));
        auto value = mitsuba::unpolarized_spectrum(m_emitter->eval(si, true));
        if constexpr (mitsuba::is_rgb_v<Spectrum>)
            return value;
        else
            return Color3fOf<Float>(dr::mean(value));
    }

    /// Mean over wavelengths so close that a narrow line cannot hide between them
    Float spectral_mean(SurfaceInteraction3f &si) const {
        constexpr size_t count = 48;
        Float sum(0.f);
        size_t lanes = si.wavelengths.size();
        for (size_t i = 0; i < count; i += lanes) {
            for (size_t k = 0; k < lanes; ++k)
                si.wavelengths.entry(k) =
                    (float) (MI_CIE_MIN +
                             (MI_CIE_MAX - MI_CIE_MIN) * (i + k + .5) / count);
            sum += dr::mean(mitsuba::unpolarized_spectrum(m_emitter->eval(si, true)));
        }
        return sum * ((float) lanes / count);
    }

    /// Attributes are linear over a face: their mean is that of the corners
    void read_attribute(std::vector<Emission> &result) const {
        size_t count = result.size();
        std::vector<uint32_t> faces(count);
        for (size_t i = 0; i < count; ++i)
            faces[i] = (uint32_t) i;
        std::vector<Color3> corner[3];
        for (int c = 0; c < 3; ++c) // just inside of the corners
            corner[c] = evaluate(faces, std::vector<float>(count, c == 1 ? .9f : .05f),
                                 std::vector<float>(count, c == 2 ? .9f : .05f));
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

    /// Sub-triangles along each edge of a face: about two for each texel along it
    uint32_t subdivisions(const float *uv, const uint32_t *face,
                          ScalarVector2i resolution) const {
        if (!m_mesh->has_vertex_texcoords())
            return 2;
        float longest = 0;
        for (int i = 0; i < 3; ++i) {
            const float *a = &uv[2 * face[i]], *b = &uv[2 * face[(i + 1) % 3]];
            longest = std::max({ longest, std::abs(a[0] - b[0]) * resolution.x(),
                                 std::abs(a[1] - b[1]) * resolution.y() });
        }
        return (uint32_t) std::clamp(std::ceil(2 * longest), 2.f, 2048.f);
    }

    /// Centroids of n^2 equal sub-triangles of each face, evaluated in batches
    void integrate_texture(const mitsuba::Object *texture,
                           std::vector<Emission> &result) const {
        HostView indices(m_mesh->faces_buffer());
        HostView uv(m_mesh->vertex_texcoords_buffer());
        ScalarVector2i resolution(64, 64); // of procedural textures
        if (auto *t = dynamic_cast<const Texture *>(texture); t && has_resolution(t))
            resolution = t->resolution();

        std::vector<uint32_t> faces;
        std::vector<float> b1, b2;
        constexpr size_t batch = 1 << 22;
        std::vector<double> sum(result.size(), 0.0), points(result.size(), 0.0);
        auto flush = [&] {
            std::vector<Color3> colors = evaluate(faces, b1, b2);
            for (size_t i = 0; i < faces.size(); ++i) {
                sum[faces[i]] += Reader::brightness(colors[i].data());
                points[faces[i]] += 1;
            }
            faces.clear();
            b1.clear();
            b2.clear();
        };
        for (uint32_t f = 0; f < result.size(); ++f) {
            uint32_t n = subdivisions(uv.data(), &indices[3 * f], resolution);
            for (uint32_t i = 0; i < n; ++i)
                for (uint32_t j = 0; i + j < n; ++j)
                    for (uint32_t upper = 0; upper < 2 && i + j + upper < n; ++upper) {
                        faces.push_back(f);
                        b1.push_back((i + (1.f + upper) / 3.f) / n);
                        b2.push_back((j + (1.f + upper) / 3.f) / n);
                    }
            if (faces.size() >= batch)
                flush();
        }
        flush();
        for (size_t f = 0; f < result.size(); ++f)
            result[f].brightness = (float) (sum[f] / points[f]);
    }

    static bool has_resolution(const Texture *texture) {
        try {
            return dr::all(texture->resolution() > 0);
        } catch (const std::exception &) {
            return false; // procedural: not implemented
        }
    }

    const Emitter *m_emitter;
    const Mesh *m_mesh;
};

} // namespace manylights

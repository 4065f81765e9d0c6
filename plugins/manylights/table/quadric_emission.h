#pragma once

/**
 * Mean emission of a sphere, a disk or a cylinder whose radiance varies or is in no table.
 */

#include "texture_image.h"

namespace manylights {

template <typename Float, typename Spectrum> class QuadricEmission {
public:
    MI_IMPORT_TYPES(Emitter, Shape)
    using Image = TextureImage<Float, Spectrum>;

    /// `to_world`: of the unit sphere, disk or cylinder
    QuadricEmission(const Emitter *emitter, const Shape *shape, LightKind kind,
                    const float (&to_world)[3][4])
        : m_surface(emitter, shape), m_kind(kind), m_to_world(to_world) {}

    /// Mean brightness over the surface; `image`: the bitmap that it shows, if it is one
    float brightness(const Image *image) const {
        return image ? mean_of_image(*image) : mean_of_points();
    }

private:
    using Surface = SurfaceEmission<Float, Spectrum>;

    /// Rings of the image, weighted with their area on the surface
    float mean_of_image(const Image &image) const {
        if (m_kind == LightKind::Cylinder)
            return image.mean(0, 0, 1, 1);
        constexpr int rings = 32;
        bool disk           = m_kind == LightKind::Disk;
        double sum          = 0;
        for (int i = 0; i < rings; ++i) {
            double low = i / (double) rings, high = (i + 1) / (double) rings;
            if (disk) // u is the radius
                sum += (high * high - low * low) * image.mean(low, 0, high, 1);
            else // v is the angle from the pole, over pi
                sum += .5 * (std::cos(kPi * low) - std::cos(kPi * high)) *
                       image.mean(0, low, 1, high);
        }
        return (float) sum;
    }

    float mean_of_points() const {
        size_t count = m_surface.varies() ? 512 : 1;
        typename Surface::Points points(count);
        for (auto &coordinates : points.p)
            coordinates.resize(count);
        for (size_t i = 0; i < count; ++i) {
            auto [a, b]   = even_point(i, 0);
            double angle  = 2 * kPi * b,
                   height = m_kind == LightKind::Sphere ? 1 - 2 * a : a;
            double radius = m_kind == LightKind::Cylinder ? 1
                            : m_kind == LightKind::Disk ? std::sqrt(a)
                                                        : std::sqrt(1 - height * height);
            double local[3] = { radius * std::cos(angle), radius * std::sin(angle),
                                m_kind == LightKind::Disk ? 0 : height };
            points.u[i]     = (float) local[0]; // of disks
            points.v[i]     = (float) local[1];
            for (int k = 0; k < 3; ++k)
                points.p[k][i] =
                    (float) (m_to_world[k][0] * local[0] + m_to_world[k][1] * local[1] +
                             m_to_world[k][2] * local[2] + m_to_world[k][3]);
        }
        std::vector<float> values = m_surface.brightness(points);
        return mean_of(values.data(), count);
    }

    Surface m_surface;
    LightKind m_kind;
    const float (&m_to_world)[3][4];
};

} // namespace manylights

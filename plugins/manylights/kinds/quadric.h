#pragma once

/**
 * What spheres, disks and cylinders have in common where they are read: the matrix that makes
 * them of the unit shape, and the mean of an emission that varies or is in no table.
 */

#include "light_bounds.h"
#include "manylights/emission/texture_image.h"

namespace manylights {

/// Object-to-world matrix of a shape, without its last row
struct ToWorld {
    float m[3][4];

    template <typename Float, typename Spectrum>
    explicit ToWorld(const mitsuba::Shape<Float, Spectrum> *shape) {
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

    float column_length(int j) const { return norm(m[0][j], m[1][j], m[2][j]); }

    float determinant() const {
        return m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1]) -
               m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0]) +
               m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0]);
    }
};

/// Mean brightness over the surface of a sphere, disk or cylinder; `image`: the bitmap that it
/// shows, null if it is none
template <typename Light, typename Float, typename Spectrum>
float mean_brightness(const mitsuba::Emitter<Float, Spectrum> *emitter,
                      const mitsuba::Shape<Float, Spectrum> *shape,
                      const ToWorld &to_world,
                      const TextureImage<Float, Spectrum> *image) {
    using Surface = SurfaceEmission<Float, Spectrum>;
    if (image)
        return Light::mean_of_image(*image);
    Surface surface(emitter, shape);
    size_t count = surface.varies() ? 512 : 1;
    typename Surface::Points points(count);
    for (auto &coordinates : points.p)
        coordinates.resize(count);
    for (size_t i = 0; i < count; ++i) {
        auto [a, b]                 = even_point(i, 0);
        std::array<double, 3> local = Light::unit_point(a, b);
        points.u[i]                 = (float) local[0]; // of disks
        points.v[i]                 = (float) local[1];
        for (int k = 0; k < 3; ++k)
            points.p[k][i] =
                (float) (to_world.m[k][0] * local[0] + to_world.m[k][1] * local[1] +
                         to_world.m[k][2] * local[2] + to_world.m[k][3]);
    }
    std::vector<float> values = surface.brightness(points);
    return mean_of(values.data(), count);
}

/// The row of a sphere, disk or cylinder, without its place; its emission is not in it if that
/// varies
template <typename Light, typename Float, typename Spectrum>
LightRow make_quadric(const mitsuba::Emitter<Float, Spectrum> *emitter,
                      const mitsuba::Shape<Float, Spectrum> *shape, Emission e,
                      const ToWorld &to_world, ShownImages<Float, Spectrum> &images) {
    if (!e.constant)
        e.brightness =
            mean_brightness<Light>(emitter, shape, to_world, images.of(emitter));
    LightRow row = make_row(Light::kind, e);
    if (!e.tabulated)
        set_primitive(row, 0, false);
    return row;
}

} // namespace manylights

#pragma once

/**
 * Emission that varies, evaluated on the host at given points of a surface.
 */

#include "emission_reader.h"
#include "surface_hit.h"
#include <array>
#include <mitsuba/render/emitter.h>
#include <mitsuba/render/shape.h>
#include <mitsuba/render/texture.h>
#include <numeric>

namespace manylights {

/// Mean of the values of `eval()` over `count` wavelengths, which it finds in `si`
template <typename Float, typename Interaction, typename F>
Float mean_over_wavelengths(Interaction &si, size_t count, const F &eval) {
    Float sum(0.f);
    size_t lanes = si.wavelengths.size();
    for (size_t i = 0; i < count; i += lanes) {
        for (size_t k = 0; k < lanes; ++k)
            si.wavelengths.entry(k) =
                (float) (MI_CIE_MIN + (MI_CIE_MAX - MI_CIE_MIN) * (i + k + .5) / count);
        sum += dr::mean(eval());
    }
    return sum * ((float) lanes / count);
}

/// Colours of lanes, on the host
template <typename Float>
std::vector<std::array<float, 3>> colors_on_host(mitsuba::Color<Float, 3> color,
                                                 size_t count) {
    std::vector<std::array<float, 3>> result(count);
    for (int c = 0; c < 3; ++c) {
        color.entry(c) += dr::zeros<Float>(count);
        HostView host(color.entry(c));
        for (size_t i = 0; i < count; ++i)
            result[i][c] = (float) host[i];
    }
    return result;
}

/// What an emitter emits at points of its shape, along the normal
template <typename Float, typename Spectrum> class SurfaceEmission {
public:
    MI_IMPORT_TYPES(Emitter, Shape, Texture)
    using Color3 = std::array<float, 3>;

    /// Primitives, their coordinates, and places, which only spheres and cylinders need
    struct Points {
        std::vector<uint32_t> primitive;
        std::vector<float> u, v;
        std::array<std::vector<float>, 3> p;
        explicit Points(size_t count) : primitive(count), u(count), v(count) {}
        size_t size() const { return primitive.size(); }
    };

    SurfaceEmission(const Emitter *emitter, const Shape *shape)
        : m_emitter(emitter), m_shape(shape) {}

    const mitsuba::Object *radiance() const {
        return ParameterReader(m_emitter).object("radiance");
    }

    /// Does the radiance claim to vary?
    bool varies() const {
        const auto *texture = dynamic_cast<const Texture *>(radiance());
        return texture && texture->is_spatially_varying();
    }

    /// Colours; three copies of the mean of a spectrum
    std::vector<Color3> evaluate(const Points &points) const {
        size_t count = points.size();
        bool placed  = !points.p[0].empty();
        if constexpr (dr::is_jit_v<Float>) {
            dr::suspend_grad<Float> detached;
            Point3f p(0.f);
            for (int i = 0; placed && i < 3; ++i)
                p[i] = dr::load<Float>(points.p[i].data(), count);
            return colors_on_host<Float>(
                color(dr::load<dr::uint32_array_t<Float>>(points.primitive.data(), count),
                      { dr::load<Float>(points.u.data(), count),
                        dr::load<Float>(points.v.data(), count) },
                      p),
                count);
        } else {
            std::vector<Color3> result(count);
            for (size_t i = 0; i < count; ++i) {
                Point3f p(0.f);
                for (int k = 0; placed && k < 3; ++k)
                    p[k] = points.p[k][i];
                Color3f value =
                    color(points.primitive[i], { points.u[i], points.v[i] }, p);
                result[i] = { value[0], value[1], value[2] };
            }
            return result;
        }
    }

    std::vector<float> brightness(const Points &points) const {
        std::vector<Color3> colors = evaluate(points);
        std::vector<float> result(colors.size());
        for (size_t i = 0; i < result.size(); ++i)
            result[i] = EmissionReader<Float, Spectrum>::brightness(colors[i].data());
        return result;
    }

private:
    Color3f color(const dr::uint32_array_t<Float> &primitive, const Point2f &uv,
                  const Point3f &p) const {
        auto pi   = surface_hit<Float, Shape>(m_shape, primitive, uv, Float(0.f), true);
        Ray3f ray = dr::zeros<Ray3f>();
        ray.o     = p;
        ray.d     = { 0.f, 0.f, 1.f };
        SurfaceInteraction3f si = m_shape->compute_surface_interaction(
            ray, pi, +mitsuba::RayFlags::All, 0, true);
        si.shape      = m_shape;
        si.prim_index = primitive;
        si.wi         = { 0.f, 0.f, 1.f };
        auto eval     = [&] {
            return mitsuba::unpolarized_spectrum(m_emitter->eval(si, true));
        };
        if constexpr (mitsuba::is_spectral_v<Spectrum>) // a narrow line is found, too
            return Color3f(mean_over_wavelengths<Float>(si, 48, eval));
        else if constexpr (mitsuba::is_rgb_v<Spectrum>)
            return eval();
        else
            return Color3f(dr::mean(eval()));
    }

    const Emitter *m_emitter;
    const Shape *m_shape;
};

inline float mean_of(const float *values, size_t count) {
    return (float) (std::accumulate(values, values + count, 0.) / (double) count);
}

/// Point i of a sequence that fills the unit square evenly (R2), shifted for each `stream`
inline std::array<double, 2> even_point(size_t i, size_t stream) {
    auto place = [&](double step, double shift) {
        double x = .5 + step * (double) i + shift * (double) stream;
        return x - std::floor(x);
    };
    return { place(.7548776662466927, .6180339887498949),
             place(.5698402909980532, .4142135623730951) };
}

} // namespace manylights

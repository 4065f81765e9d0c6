#pragma once

#include "light_bounds.h"
#include "light_geometry.h"
#include "manylights/emission/emission_reader.h"
#include <mitsuba/core/qmc.h>
#include <mitsuba/render/emitter.h>
#include <mitsuba/render/shape.h>
#include <optional>

namespace manylights {

/// Any other emitter of finite extent (a projector, an exotic shape) as a whole: its own plugin
/// chooses points on it, and has their density and normals. Its row: mean position[3], variance
/// of the position; its brightness: flux / (4 pi)
struct OtherLight : WithoutSurface {
    static constexpr LightKind kind = LightKind::Other;
    static constexpr bool is_delta  = false;

    /// Where an emitter is; none if that is not known. `delta`: is it a point?
    template <typename Float, typename Spectrum>
    static auto find_box(const mitsuba::Emitter<Float, Spectrum> *emitter, bool delta) {
        using Box = decltype(emitter->bbox());
        Box box;
        try {
            box = emitter->shape() ? emitter->shape()->bbox() : emitter->bbox();
        } catch (const std::exception &) { // written in Python, without one
            return std::optional<Box>();
        }
        if (!box.valid() && delta) { // projectors have no box, only a transformation
            auto position = emitter->world_transform().translation();
            for (int i = 0; i < 3; ++i)
                box.min[i] = box.max[i] = read_scalar(position.entry(i));
        }
        bool finite =
            dr::all(dr::isfinite(box.min) && dr::isfinite(box.max) && box.min <= box.max);
        return finite ? std::optional<Box>(box) : std::nullopt;
    }

    template <typename Box> static HostLight read(const Box &box, float brightness) {
        Emission e;
        e.brightness       = brightness;
        LightRow row       = make_row(kind, e);
        LightBounds bounds = {};
        double square      = 0;
        for (int i = 0; i < 3; ++i) {
            bounds.box_min[i] = (float) box.min[i];
            bounds.box_max[i] = (float) box.max[i];
            bounds.mean[i]    = .5f * ((float) box.min[i] + (float) box.max[i]);
            double extent     = (double) box.max[i] - box.min[i];
            square += extent * extent / 12;
        }
        bounds.variance = (float) (square / 3);
        std::copy_n(bounds.mean, 3, row.geometry);
        row.geometry[3] = bounds.variance;
        return { row, bounds };
    }

    /// Mean weight of rays that the emitter sends out; 0 if that is not known: it may not be
    /// able to send any, or a narrow beam was missed
    template <typename Float, typename Spectrum>
    static float emitted_power(const mitsuba::Emitter<Float, Spectrum> *emitter) {
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

    static double power(const LightRow &row) {
        double brightness = row.brightness;
        return 4 * kPi * brightness;
    }

    template <typename Float>
    static Appearance<Float> appearance(const Row<Float> &row,
                                        const typename Row<Float>::Point3f &x, float) {
        return { row.vector(0) - x, row[3], Float(1.f) };
    }

    template <typename Float>
    static LightPoint<Float> sample(const Row<Float> &,
                                    const typename Row<Float>::Point3f &,
                                    const typename Row<Float>::Point2f &) {
        return dr::zeros<LightPoint<Float>>();
    }
};

} // namespace manylights

#pragma once

/**
 * The albedo that a camera sees, for denoisers: through mirrors, glass and holes, of the first
 * surface that scatters light widely. There it is Mitsuba's `eval_diffuse_reflectance`, or, if
 * nothing about the surface is diffuse, what it reflects in all.
 *
 * Where rays go on is chosen at random, with numbers that come from the bits of the camera ray.
 */

#include "film_color.h"
#include "manylights/base/loop.h"
#include "manylights/base/random.h"
#include "manylights/scene/scene_shapes.h"
#include <mitsuba/render/bsdf.h>
#include <mitsuba/render/interaction.h>

namespace manylights {

/// A lobe is as good as a mirror's if the density of a direction in it is so high: about what
/// GGX has with a roughness of .07
constexpr float kSharpDensity = 16.f;
/// Surfaces whose BSDF is below this aside of the mirror direction show what they reflect; that
/// of a diffuse one is .2 of its albedo
constexpr float kFaintBsdf = .01f;
/// No more surfaces are looked through
constexpr uint32_t kMostSurfaces = 16;

template <typename Float, typename Spectrum> class VisibleAlbedo {
public:
    MI_IMPORT_TYPES(Scene, BSDFPtr)
    using Flags = mitsuba::BSDFFlags;

    explicit VisibleAlbedo(const Scene *scene) : m_scene(scene) {}

    /// Of a ray with its first intersection; black where it meets none
    Color3f at(const SurfaceInteraction3f &si, const PreliminaryIntersection3f &pi,
               const Ray3f &ray, Mask active) const {
        active &= si.is_valid();
        if (dr::none_or<false>(active))
            return 0.f;
        UnpolarizedSpectrum result;
        if (dr::is_jit_v<Float> && !has_lobes())
            result = diffuse(si, si.bsdf(), active) & active;
        else
            result = walk(pi, ray, active);
        return to_color(result, ray, active);
    }

    /// In the colours of the film, as Mitsuba's `aov` does it
    static Color3f to_color(const UnpolarizedSpectrum &spectrum, const Ray3f &ray,
                            Mask active) {
        UnpolarizedSpectrum value = spectrum;
        if constexpr (mitsuba::is_spectral_v<Spectrum>) {
            auto pdf = mitsuba::pdf_rgb_spectrum(ray.wavelengths);
            value *= dr::select(pdf != 0.f, dr::rcp(pdf), 0.f);
        }
        return film_color<Float, Spectrum>(value, ray.wavelengths, active);
    }

private:
    struct Walk {
        Ray3f ray;
        PreliminaryIntersection3f pi;
        UnpolarizedSpectrum throughput, result;
        UInt32 depth;
        dr::PCG32<UInt32> rng;
        Mask active;
        DRJIT_STRUCT(Walk, ray, pi, throughput, result, depth, rng, active)
    };

    /// Is any surface more than diffuse?
    bool has_lobes() const {
        bool result = false;
        for_each_shape(m_scene, [&](const auto *shape) {
            result |= shape->bsdf() && is_more(shape->bsdf()->flags());
        });
        return result;
    }

    template <typename Value> static auto is_more(const Value &flags) {
        return has_flag(flags, Flags::Glossy) || has_flag(flags, Flags::Delta) ||
               has_flag(flags, Flags::Null);
    }

    /// Without derivatives: it is for denoisers
    UnpolarizedSpectrum walk(const PreliminaryIntersection3f &pi, const Ray3f &ray,
                             Mask active) const {
        dr::suspend_grad<Float> no_gradients;
        Walk w{ dr::detach<true>(ray),
                dr::detach<true>(pi),
                UnpolarizedSpectrum(1.f),
                UnpolarizedSpectrum(0.f),
                UInt32(0),
                make_rng(ray),
                active };
        loop(
            w, [](const Walk &w) { return w.active; }, [&](Walk &w) { step(w); },
            "Albedo");
        return w.result;
    }

    /// One surface: the walk ends there or goes on
    void step(Walk &w) const {
        SurfaceInteraction3f si =
            w.pi.compute_surface_interaction(w.ray, +mitsuba::RayFlags::All, w.active);
        w.active &= si.is_valid();
        if (dr::none_or<false>(w.active))
            return;
        BSDFPtr bsdf  = si.bsdf();
        Mask more     = w.active && is_more(bsdf->flags()), goes_on(false);
        Vector3f next = si.wi;
        UnpolarizedSpectrum weight(0.f);
        if (dr::any_or<true>(more))
            std::tie(goes_on, next, weight) = look_through(w, si, bsdf, more);
        Mask ends = w.active && !goes_on, has_diffuse = has_diffuse_lobe(bsdf);
        UnpolarizedSpectrum albedo = weight;
        if (dr::any_or<true>(ends && has_diffuse))
            albedo =
                dr::select(has_diffuse, diffuse(si, bsdf, ends && has_diffuse), weight);
        dr::masked(w.result, ends) = w.throughput * dr::clip(albedo, 0.f, 1.f);

        w.depth += 1u;
        w.active = goes_on && w.depth < kMostSurfaces;
        if (dr::none_or<false>(w.active))
            return;
        dr::masked(w.throughput, w.active) = w.throughput * weight;
        w.ray                              = si.spawn_ray(si.to_world(next));
        w.pi =
            m_scene->ray_intersect_preliminary(w.ray, /* coherent = */ false, w.active);
    }

    /// Does the walk go on, in which direction and with which weight? The latter is an estimate of
    /// all that the surface scatters, too.
    MI_NOINLINE std::tuple<Mask, Vector3f, UnpolarizedSpectrum>
    look_through(Walk &w, const SurfaceInteraction3f &si, const BSDFPtr &bsdf,
                 Mask active) const {
        mitsuba::BSDFContext ctx;
        Float u0         = w.rng.template next_float<Float>(),
              u1         = w.rng.template next_float<Float>(),
              u2         = w.rng.template next_float<Float>();
        auto [bs, value] = bsdf->sample(ctx, si, u0, Point2f(u1, u2), active);
        Vector3f aside   = aside_of(si.wi), other(-aside.x(), -aside.y(), aside.z());
        // Bumps may hide one of the two
        UnpolarizedSpectrum wide = dr::maximum(
            mitsuba::unpolarized_spectrum(bsdf->eval(ctx, si, aside, active)),
            mitsuba::unpolarized_spectrum(bsdf->eval(ctx, si, other, active)));
        Mask straight = has_flag(bs.sampled_type, Flags::Null),
             sharp    = has_flag(bs.sampled_type, Flags::Delta) || bs.pdf > kSharpDensity,
             faint    = dr::max(wide) < kFaintBsdf;
        // Radiance is denser in glass, albedo is not
        UnpolarizedSpectrum weight =
            mitsuba::unpolarized_spectrum(value) * dr::square(bs.eta);
        return { active && bs.pdf > 0.f && (straight || (sharp && faint)), bs.wo,
                 weight & active };
    }

    /// A direction that no narrow lobe contains: at 45 degrees, out of the plane of incidence
    static Vector3f aside_of(const Vector3f &wi) {
        Float length = dr::sqrt(dr::square(wi.x()) + dr::square(wi.y()));
        Mask tilted  = length > 1e-4f;
        Float scale  = dr::InvSqrtTwo<Float> / dr::select(tilted, length, 1.f);
        return { dr::select(tilted, -wi.y() * scale, dr::InvSqrtTwo<Float>),
                 dr::select(tilted, wi.x() * scale, 0.f),
                 dr::copysign(Float(dr::InvSqrtTwo<Float>), wi.z()) };
    }

    Mask has_diffuse_lobe(const BSDFPtr &bsdf) const {
        return has_flag(bsdf->flags(), Flags::Diffuse);
    }

    UnpolarizedSpectrum diffuse(const SurfaceInteraction3f &si, const BSDFPtr &bsdf,
                                Mask active) const {
        return mitsuba::unpolarized_spectrum(bsdf->eval_diffuse_reflectance(si, active));
    }

    static dr::PCG32<UInt32> make_rng(const Ray3f &ray) {
        auto bits = [](const Float &x) {
            return dr::reinterpret_array<UInt32>(dr::float32_array_t<Float>(x));
        };
        return seeded_rng<UInt32>(bits(ray.d.x()) ^ (bits(ray.o.x()) * 0x9e3779b9u) ^
                                      (bits(ray.o.z()) * 0x85ebca6bu),
                                  bits(ray.d.y()) ^ (bits(ray.o.y()) * 0xc2b2ae35u), 1);
    }

    const Scene *m_scene;
};

} // namespace manylights

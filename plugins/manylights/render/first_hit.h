#pragma once

/**
 * What a camera ray meets first, for the channels of aov_list.h: Mitsuba's `aov`, but for albedo.
 * No random number of the sampler is used, so that the image is the same without these channels.
 */

#include "aov_list.h"
#include "manylights/scene/hidden_emitters.h"
#include "manylights/scene/lamps_in_view.h"
#include "shape_numbers.h"
#include "visible_albedo.h"

namespace manylights {

template <typename Float, typename Spectrum> class FirstHit {
public:
    MI_IMPORT_TYPES(Scene)
    using Numbers = ShapeNumbers<Float, Spectrum>;
    using Lamps   = LampsInView<Float, Spectrum>;

    /// @param lamps  that are put on the film otherwise, too; may be null
    FirstHit(const Scene *scene, const Numbers &numbers, bool hide_emitters,
             const Lamps *lamps)
        : m_scene(scene), m_numbers(numbers), m_hide_emitters(hide_emitters),
          m_lamps(lamps) {}

    /// Write the channels of a list
    MI_NOINLINE void write(const std::vector<Aov> &aovs, const RayDifferential3f &ray,
                           Float *values, Mask active) const {
        auto pi = m_scene->ray_intersect_preliminary(ray, /* coherent = */ true, active);
        if (m_hide_emitters)
            skip_emitters(m_scene, Ray3f(ray), pi, active);
        auto si = pi.compute_surface_interaction(ray, +mitsuba::RayFlags::All, active);
        Color3f emitted(0.f);
        for (const Aov &aov : aovs)
            if (aov.type == AovType::Emission)
                emitted = emission(si, ray, active);
        dr::masked(si, !si.is_valid()) = dr::zeros<SurfaceInteraction3f>();
        for (const Aov &aov : aovs)
            values = aov.type == AovType::Emission
                         ? put(emitted, values)
                         : write(aov.type, si, pi, ray, values, active);
    }

private:
    /// Returns where the next ones go
    Float *write(AovType type, SurfaceInteraction3f &si,
                 const PreliminaryIntersection3f &pi, const RayDifferential3f &ray,
                 Float *values, Mask active) const {
        switch (type) {
            case AovType::Albedo:
                return put(
                    VisibleAlbedo<Float, Spectrum>(m_scene).at(si, pi, ray, active),
                    values);
            case AovType::Depth:
                return put(dr::Array<Float, 1>(dr::select(si.is_valid(), si.t, 0.f)),
                           values);
            case AovType::Position:
                return put(si.p, values);
            case AovType::UV:
                return put(si.uv, values);
            case AovType::GeometricNormal:
                return put(si.n, values);
            case AovType::ShadingNormal:
                return put(shading_normal(si, active), values);
            case AovType::DpDu:
                return put(si.dp_du, values);
            case AovType::DpDv:
                return put(si.dp_dv, values);
            case AovType::DuvDx:
                si.compute_uv_partials(ray);
                return put(known(si.duv_dx, si), values);
            case AovType::DuvDy:
                si.compute_uv_partials(ray);
                return put(known(si.duv_dy, si), values);
            case AovType::PrimIndex:
                return put(dr::Array<Float, 1>(Float(si.prim_index)), values);
            case AovType::ShapeIndex:
            case AovType::Emission: // of the environment, too: not of the surface alone
                break;
        }
        return put(dr::Array<Float, 1>(Float(m_numbers.at(m_scene, si, active))), values);
    }

    /// Of what is in sight, as it leaves there: media are not considered
    Color3f emission(const SurfaceInteraction3f &si, const Ray3f &ray,
                     Mask active) const {
        auto emitter = si.emitter(m_scene, active);
        active &= emitter != nullptr && !m_hide_emitters;
        if (dr::none_or<false>(active))
            return 0.f;
        auto radiance = mitsuba::unpolarized_spectrum(emitter->eval(si, active));
        if (m_lamps)
            radiance *= m_lamps->weight(si, ray.d, active);
        return VisibleAlbedo<Float, Spectrum>::to_color(radiance & active, ray, active);
    }

    /// With the bumps of the material
    Normal3f shading_normal(const SurfaceInteraction3f &si, Mask active) const {
        active &= si.is_valid();
        if (dr::none_or<false>(active))
            return 0.f;
        Normal3f result             = si.bsdf()->sh_frame(si, active).n;
        dr::masked(result, !active) = Normal3f(0.f);
        return result;
    }

    /// Where nothing was hit, and along a surface, these are no numbers
    static Vector2f known(const Vector2f &partial, const SurfaceInteraction3f &si) {
        Mask finite = si.is_valid() && dr::all(dr::isfinite(partial));
        return dr::select(finite, partial, Vector2f(0.f));
    }

    template <typename Vector> static Float *put(const Vector &vector, Float *values) {
        for (size_t i = 0; i < vector.size(); ++i)
            *values++ = vector.entry(i);
        return values;
    }

    const Scene *m_scene;
    const Numbers &m_numbers;
    bool m_hide_emitters;
    const Lamps *m_lamps;
};

} // namespace manylights

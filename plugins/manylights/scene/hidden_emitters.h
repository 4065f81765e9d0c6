#pragma once

/// The parameter `hide_emitters`: what a camera sees behind the area emitters.

#include "manylights/base/loop.h"
#include "shadow_ray.h"
#include <mitsuba/render/interaction.h>
#include <mitsuba/render/scene.h>

namespace manylights {

/**
 * Go past the area emitters that are hit first along a ray. `pi` is the first intersection
 * and becomes the first one that is no emitter, with its distance from the ray's origin.
 */
template <typename Scene, typename Ray3f, typename Intersection, typename Mask>
void skip_emitters(const Scene *scene, const Ray3f &ray, Intersection &pi, Mask active) {
    using Float = typename Intersection::Float;
    struct State {
        Intersection pi;
        Float passed;
        Mask active;
        DRJIT_STRUCT(State, pi, passed, active)
    };
    State state{ pi, Float(0.f), active };
    auto on_emitter = [](const State &s) { // instances have no shape yet
        return s.active && s.pi.is_valid() && s.pi.shape != nullptr &&
               s.pi.shape->emitter() != nullptr;
    };
    loop(
        state, on_emitter,
        [&](State &s) {
            Ray3f rest = ray;
            rest.o     = ray(s.passed);
            auto si = s.pi.compute_surface_interaction(rest, +mitsuba::RayFlags::Minimal,
                                                       s.active);
            Ray3f next = si.spawn_ray(ray.d);
            // Along a surface the offset from it does not get ahead, and it is met for ever
            Float least = s.passed + s.pi.t + ray_epsilon<Float>(si.p),
                  ahead = dr::dot(next.o - ray.o, ray.d);
            s.passed    = dr::maximum(least, ahead);
            next.o += ray.d * (s.passed - ahead);
            s.pi = scene->ray_intersect_preliminary(next, true, s.active);
        },
        "Hidden emitters");
    pi = state.pi;
    pi.t += state.passed;
}

} // namespace manylights

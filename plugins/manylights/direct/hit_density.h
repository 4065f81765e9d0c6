#pragma once

/**
 * The density of light sampling for a direction that was found in another way.
 *
 * The balance heuristic takes p(light) p(point | light) as the density of the whole light
 * side: p is the probability of being a candidate, a closed form for any light, so it is
 * evaluated alike for a chosen light and for one that was hit.
 */

#include "light_samples.h"

namespace manylights {

template <typename Float, typename Spectrum> class HitDensity {
public:
    MI_IMPORT_TYPES(Scene, Emitter)
    using Lights    = SceneLights<Float, Spectrum>;
    using Emission  = SceneEmission<Float, Spectrum>;
    using FloatD    = typename Lights::FloatD;
    using UInt32D   = typename Lights::UInt32D;
    using MaskD     = typename Lights::MaskD;
    using Distances = SegmentDistances<FloatD>;

    HitDensity(const Scene *scene, const Lights &lights, const Emission &emission,
               const Strategy &strategy)
        : m_scene(scene), m_lights(lights), m_emission(emission), m_strategy(strategy) {}

    /// Density with which lights are sampled in the direction that hit `light` or the
    /// environment, seen from the receiver of a vertex after `depth` others and for its random
    /// number of the tree
    MI_NOINLINE Float density(const Receiver<FloatD> &at, const UInt32D &depth,
                              const Float &u_tree, const SurfaceInteraction3f &hit,
                              const UInt32D &light, Mask active) const {
        auto p = at.p;
        if (at.extent == Extent::Either)
            p -= at.distance * at.wi;
        Interaction3f from(0.f, hit.time, hit.wavelengths, Point3f(p));
        Float result(0.f);
        Mask found = active && light < kOnlyHit;
        if (m_lights.can_be_hit() && dr::any_or<true>(found)) {
            dr::suspend_grad<Float> detached;
            const auto &tree = m_lights.tree();
            Row<FloatD> row  = tree.row(light, plain(found));
            FloatD pdf = by_kind<FloatD>(row, m_lights.table_kinds(), [&](auto kind) {
                return kind.pdf(row, p, plain(hit.p), plain(Vector3f(hit.n)));
            });
            result     = Float(pdf);
            if (tree.kinds.has(LightKind::Other)) {
                Mask other = found && row.is(LightKind::Other);
                if (dr::any_or<true>(other)) {
                    DirectionSample3f ds(m_scene, hit, from);
                    dr::masked(result, other) =
                        m_emission.emitter_of(row)->pdf_direction(from, ds, other);
                }
            }
            if (at.extent == Extent::Either)
                result *= Float(
                    dr::select(at.length > 0.f,
                               distances_to(at, row, tree.kinds).pdf(at.distance), 1.f));
            result *=
                Float(m_strategy.with_source<FloatD>(depth, [&](const auto &source) {
                    return source.inclusion_probability(tree, at, light, plain(u_tree),
                                                        plain(found));
                }));
            result = dr::select(found, result, 0.f);
        }
        Mask missed = active && !hit.is_valid();
        if (const Emitter *environment = m_scene->environment();
            environment && environment->sampling_weight() > 0 &&
            dr::any_or<true>(missed)) {
            DirectionSample3f ds(m_scene, hit, from);
            dr::masked(result, missed) = m_strategy.infinite_probability *
                                         environment->pdf_direction(from, ds, missed);
            if (at.extent == Extent::Either)
                dr::masked(result, missed && Mask(at.length > 0.f)) =
                    result * Float(Distances::transmittance_pdf(at, at.distance));
        }
        return result;
    }

private:
    const Scene *m_scene;
    const Lights &m_lights;
    const Emission &m_emission;
    const Strategy &m_strategy;
};

} // namespace manylights

#pragma once

/**
 * Stage 3: shadow rays, to all candidates or to s of the kept lights, chosen by
 * threshold-systematic sampling with target |C F|. (The talk draws s reservoirs; here the
 * items of large target are taken for sure, the rest at equidistant points.)
 *
 * Estimate = sum over the chosen of V C F max(1, tau / g), g the target, tau the step.
 */

#include "group_light.h"
#include "kept_lights.h"
#include "manylights/learning/visibility.h"
#include "manylights/scene/media.h"

namespace manylights {

template <typename Float, typename Spectrum> class ShadowRays {
public:
    MI_IMPORT_TYPES(Scene)
    using Lights          = SceneLights<Float, Spectrum>;
    using Media           = manylights::Media<Float, Spectrum>;
    using Samples         = LightSamples<Float, Spectrum>;
    using Sample          = typename Samples::Sample;
    using InfiniteSamples = typename Samples::InfiniteSamples;
    using Reader          = typename Samples::Reader;
    using Vertex          = typename Samples::Vertex;
    using Kept            = manylights::Kept<Float, Spectrum>;
    using FloatD          = typename Lights::FloatD;
    using UInt32D         = typename Lights::UInt32D;
    using MaskD           = typename Lights::MaskD;
    using Rng             = VertexRng<FloatD>;
    using GroupLight      = manylights::GroupLight<Float, Spectrum>;
    using GroupSums       = typename GroupLight::Sums;

    ShadowRays(const Scene *scene, const Lights &lights, const Media &media,
               const Strategy &strategy, const Samples &samples)
        : m_scene(scene), m_lights(lights), m_media(media), m_strategy(strategy),
          m_samples(samples) {}

    /// A shadow ray for each kept light, or for some of them
    MI_NOINLINE Spectrum trace_kept(const Vertex &vertex, Kept kept, GroupLight &light,
                                    Mask active) const {
        // Find the step tau of the systematic sampling, lights at infinity included
        InfiniteSamples infinite = m_samples.sample_infinite(vertex, active);
        FloatD offset            = plain(vertex.u.selection);
        FloatD tau(0.f);
        if (m_strategy.chooses) {
            for (uint32_t i = 0; i < m_strategy.infinite; ++i) {
                FloatD target = m_samples.target(infinite[i].unoccluded());
                if (m_lights.groups().evens())
                    target *= m_lights.groups().evening(
                        m_samples.infinite_group(vertex, i, active), plain(active));
                kept.target[m_strategy.slots + i] = target;
            }
            tau = selection_threshold<FloatD>(kept.target, m_strategy.items,
                                              m_strategy.rays);
        }

        struct State {
            UInt32D ray;
            Spectrum result;
            Rng rng;
            GroupSums groups;
            DRJIT_STRUCT(State, ray, result, rng, groups)
        };
        // Trace a ray to each item that is chosen; an item below tau gets what others lack
        State state{ UInt32D(0), Spectrum(0.f), media_rng(vertex), light.take() };
        UInt32D rays = dr::opaque<UInt32D>(m_strategy.rays);
        MaskD on     = plain(active);
        loop(
            state, [&](const State &s) { return on && s.ray < rays; },
            [&](State &s) {
                Selected<FloatD> chosen{ s.ray, FloatD(1.f), MaskD(true) };
                FloatD boost(1.f);
                if (m_strategy.chooses) {
                    chosen = select_item<FloatD>(kept.target, m_strategy.items, tau,
                                                 (FloatD(s.ray) + offset) * tau);
                    boost  = dr::maximum(1.f, tau / chosen.target);
                }
                Spectrum found = trace(vertex, kept, infinite, chosen, s.rng, active);
                s.result += found * Float(boost);
                if (s.groups.size() > 0)
                    light.add(s.groups, found, Float(boost),
                              group_of(vertex, kept, chosen, active), active);
                s.ray += 1u;
            },
            "Direct light: shadow rays");
        light.give(std::move(state.groups));
        return state.result;
    }

    /// No resampling, a shadow ray for every candidate
    Spectrum trace_candidates(const Vertex &vertex, Counts<Float> &counts,
                              GroupLight &light, Mask active) const {
        Spectrum result(0.f);
        Rng rng = m_strategy.source == Source::AllLights
                      ? media_rng(vertex)
                      : make_rng(plain_sample(vertex.u));
        if (m_strategy.slots > 0)
            m_strategy.with_source<FloatD>(vertex.depth, [&](const auto &source) {
                result = trace_candidates(
                    vertex, source.cursor(m_lights.tree(), vertex, plain(vertex.u.tree)),
                    rng, counts, light, active);
            });
        if (m_strategy.infinite == 0)
            return result;
        InfiniteSamples infinite = m_samples.sample_infinite(vertex, active);
        for (uint32_t i = 0; i < m_strategy.infinite; ++i) {
            Spectrum arrives = trace_sample(vertex, infinite[i], rng, active);
            result += arrives;
            if (light.is_wanted())
                light.add(arrives, m_samples.infinite_group(vertex, i, active), active);
        }
        return result;
    }

private:
    template <typename Cursor>
    Spectrum trace_candidates(const Vertex &vertex, const Cursor &cursor, Rng &rng,
                              Counts<Float> &counts, GroupLight &light,
                              Mask active) const {
        struct State {
            Cursor cursor;
            UInt32D slot;
            Spectrum result;
            Rng rng;
            FloatD expected;
            GroupSums groups;
            DRJIT_STRUCT(State, cursor, slot, result, rng, expected, groups)
            State(const Cursor &cursor, Rng &&rng, GroupSums &&groups)
                : cursor(cursor), slot(0), result(0.f), rng(std::move(rng)),
                  expected(0.f), groups(std::move(groups)) {}
        };
        State state(cursor, std::move(rng), light.take());
        MaskD on = plain(active);
        loop(
            state, [&](const State &s) { return on && s.cursor.has_next(); },
            [&](State &s) {
                auto candidate = s.cursor.next(m_lights.tree(), vertex.at, s.rng);
                FloatD p       = candidate.probability;
                Mask valid     = active && candidate.valid;
                Sample sample  = m_samples.sample(vertex, candidate.light, p, s.slot,
                                                  /* target_only = */ false, valid);
                sample.value *= Float(dr::rcp(p));
                Spectrum arrives = trace_sample(vertex, sample, s.rng, valid);
                s.result += arrives;
                teach(vertex, candidate.light, sample, arrives, plain(valid));
                if (m_strategy.params.counts)
                    s.expected += m_samples.expected(
                        m_samples.target(sample.unoccluded()) * candidate.visibility,
                        candidate.visibility, plain(valid));
                if (s.groups.size() > 0)
                    light.add(s.groups, arrives, Float(1.f),
                              m_lights.groups().of_light(m_lights.tree(), candidate.light,
                                                         plain(valid)),
                              valid);
                s.slot += 1u;
            },
            "Direct light: rays to all candidates");
        counts.add(state.slot, state.cursor.visits, active);
        counts.expected += state.expected;
        rng = std::move(state.rng);
        light.give(std::move(state.groups));
        return state.result;
    }

    /// The group of a chosen item
    UInt32D group_of(const Vertex &vertex, const Kept &kept,
                     const Selected<FloatD> &chosen, Mask active) const {
        UInt32D result(0);
        MaskD on = plain(active) && chosen.valid;
        if (m_strategy.slots > 0) {
            UInt32D slot = dr::minimum(chosen.item, m_strategy.slots - 1u);
            result       = m_lights.groups().of_light(
                m_lights.tree(), read_slot<UInt32D>(kept.light, slot, m_strategy.slots),
                on && chosen.item < m_strategy.slots);
        }
        for (uint32_t i = 0; i < m_strategy.infinite; ++i) {
            MaskD this_one = on && chosen.item == m_strategy.slots + i;
            if (dr::any_or<true>(this_one))
                dr::masked(result, this_one) =
                    m_samples.infinite_group(vertex, i, Mask(this_one));
        }
        return result;
    }

    /// The chosen item's contribution, with visibility
    Spectrum trace(const Vertex &vertex, const Kept &kept,
                   const InfiniteSamples &infinite, const Selected<FloatD> &chosen,
                   Rng &rng, Mask active) const {
        active &= chosen.valid;
        Sample sample = dr::zeros<Sample>();
        if (m_strategy.slots > 0) {
            UInt32D slot  = dr::minimum(chosen.item, m_strategy.slots - 1u);
            FloatD weight = read_slot<FloatD>(kept.weight, slot, m_strategy.slots);
            Mask finite   = active && chosen.item < m_strategy.slots && weight > 0.f;
            sample        = kept_sample(vertex, kept, slot, finite);
            sample.value  = sample.value * Float(weight) & finite;
        }
        for (size_t i = 0; i < m_strategy.infinite; ++i)
            sample =
                dr::select(active && chosen.item == (uint32_t) (m_strategy.slots + i),
                           infinite[i], sample);

        Spectrum result = trace_sample(vertex, sample, rng, active);
        if (m_lights.tree().visibility) {
            UInt32D slot = dr::minimum(chosen.item, m_strategy.slots - 1u);
            teach(vertex, read_slot<UInt32D>(kept.light, slot, m_strategy.slots), sample,
                  result, plain(active) && chosen.item < m_strategy.slots);
        }
        return result;
    }

    /// What a ray has found, for those who learn
    void teach(const Vertex &vertex, const UInt32D &light, const Sample &sample,
               const Spectrum &arrives, const MaskD &traced) const {
        if (!m_lights.tree().visibility)
            return;
        // Far from the smallest floats, which some threads round to zero
        constexpr float least = 1e-30f;
        count_ray(m_lights.tree(), vertex.at.cell, light,
                  m_samples.target(arrives) > least,
                  traced && m_samples.target(sample.unoccluded()) > least);
    }

    /// F / p of what is in a slot
    Sample kept_sample(const Vertex &vertex, const Kept &kept, const UInt32D &slot,
                       Mask active) const {
        if constexpr (!dr::is_jit_v<Float>)
            if (m_strategy.keeps_samples)
                return kept.sample[slot];
        return m_samples.sample(
            vertex, read_slot<UInt32D>(kept.light, slot, m_strategy.slots),
            read_slot<FloatD>(kept.probability, slot, m_strategy.slots), slot,
            /* target_only = */ false, active);
    }

    Spectrum trace_sample(const Vertex &vertex, const Sample &sample, Rng &rng,
                          Mask active) const {
        // Drops invalid values as well
        Spectrum value = sample.unoccluded();
        Mask counts(Reader::target(value) > 0.f);
        if (has_derivatives(value))
            counts |= dr::all(dr::isfinite(mitsuba::unpolarized_spectrum(value)));
        active &= counts;
        if (dr::none_or<false>(active))
            return Spectrum(0.f);
        return visible(vertex, sample, rng, active);
    }

    /// What arrives of a sample: all or nothing without media
    Spectrum visible(const Vertex &vertex, const Sample &sample, Rng &rng,
                     Mask active) const {
        if (!vertex.inside) {
            Mask occluded = m_scene->ray_test(
                shadow_ray<Float, Spectrum>(vertex.si, sample.p, sample.close), active);
            return sample.unoccluded() & (active && !occluded);
        }
        Interaction3f origin = vertex.origin();
        if (vertex.at.extent == Extent::Segment)
            origin.p = sample.from;
        auto medium =
            m_media.medium_beyond(vertex.si, vertex.inside->medium, sample.p - origin.p,
                                  vertex.on_surface(active));
        return sample.through(m_media.transmittance(origin, sample.p, sample.close,
                                                    medium, rng, active)) &
               active;
    }

    /// Numbers for shadow rays through heterogeneous media, each ray with those after the last
    Rng media_rng(const Vertex &vertex) const {
        return m_media.kinds().heterogeneous ? make_rng(plain_sample(vertex.u), 2)
                                             : Rng();
    }

    const Scene *m_scene;
    const Lights &m_lights;
    const Media &m_media;
    const Strategy &m_strategy;
    const Samples &m_samples;
};

} // namespace manylights

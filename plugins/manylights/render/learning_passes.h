#pragma once

/**
 * What is learnt while rendering: visibility, from the shadow rays of the training passes of a
 * plan, which come first and count in the image. All other passes use the factors that these
 * rays gave. The counts can be read and written, so that parts of a job share them.
 */

#include "group_levels.h"
#include "manylights/base/host_view.h"
#include "manylights/base/recording.h"
#include "manylights/choice/parameters.h"
#include "manylights/scene/scene_lights.h"
#include "pass_plan.h"
#include "passes.h"
#include <mitsuba/render/sensor.h>

namespace manylights {

template <typename Float, typename Spectrum> class LearningPasses {
public:
    MI_IMPORT_TYPES(Scene, Sensor, Film)
    using Lights = SceneLights<Float, Spectrum>;
    using Counts = mitsuba::DynamicBuffer<UInt32>;

    explicit LearningPasses(const SamplingParameters &params) : m_params(params) {}

    /// Ends what \ref start began, however that comes
    class Session {
    public:
        explicit Session(LearningPasses &learning) : m_learning(learning) {}
        ~Session() { m_learning.stop(); }
        Session(const Session &) = delete;

    private:
        LearningPasses &m_learning;
    };

    MANYLIGHTS_TRAVERSE(m_counts)

    void traverse(mitsuba::TraversalCallback *cb) {
        cb->put("visibility.counts", m_counts, mitsuba::ParamFlags::NonDifferentiable);
    }

    /// The counts were written: all passes that follow use them
    void set_written() {
        m_frozen    = dr::width(m_counts) > 0;
        m_continues = false;
    }

    /// How many counts were written
    size_t written() const { return m_frozen ? dr::width(m_counts) : 0; }

    /// The next rendering knows nothing of those before
    void forget() {
        m_counts = Counts();
        m_frozen = m_continues = false;
    }

    bool keeps() const { return m_params.learn_visibility == LearnVisibility::Keep; }

    /// Is there anything to learn?
    bool can_learn(const Lights &lights) const {
        return m_params.learn_visibility != LearnVisibility::No &&
               !m_params.considers_all(lights.tree().light_count);
    }

    /// The passes of a rendering that has no plan
    PassPlan plan(const Lights &lights, const Scene *scene, const SamplerKind &sampler,
                  uint32_t spp, uint64_t pixels) const {
        if (m_frozen || !can_learn(lights) || (double) pixels * spp < least_total(scene))
            return PassPlan::whole(spp);
        return PassPlan::learning(spp, pixels, !sampler.divides());
    }

    /// `job`: there is a plan, whose passes may come in several renderings
    void start(Lights &lights, const Scene *scene, const Sensor *sensor,
               const PassPlan &plan, double samples, bool job) {
        m_lights  = nullptr;
        m_job     = job;
        bool anew = !plan.empty() && plan[0].starts_learning() && (job || !m_frozen);
        if ((anew || !m_continues) && !keeps())
            lights.set_group_levels({});
        if (!can_learn(lights)) {
            if (m_frozen)
                refuse_counts(0);
            return;
        }
        if (!anew && !m_frozen && !(m_continues || keeps()))
            return;
        if (is_recorded<Float>())
            refuse_recording(lights, job);
        m_lights = &lights;
        if (anew) {
            lights.start_learning(scene, sensor, samples, keeps());
            m_frozen = false;
        } else if (m_frozen && !(m_continues && lights.learner().count_size() > 0)) {
            lights.start_learning(scene, sensor, samples, false);
            write_counts();
        }
        m_continues = job;
    }

    void start_pass(const PlannedPass &pass) {
        if (m_lights)
            m_lights->change_learner(
                [&](auto &learner) { learner.count(pass.role == Role::Train); });
    }

    /// `first_layer`: of the groups of lights among the film's channels
    void end_pass(const PlannedPass &pass, Film *film, size_t first_layer) {
        if (!m_lights || pass.role != Role::Train)
            return;
        m_lights->change_learner([&](auto &learner) { learner.learn(m_lights->tree()); });
        if (m_lights->groups().count() > 0)
            m_lights->set_group_levels(group_levels<Float, Spectrum>(
                film, first_layer, m_lights->groups().count()));
    }

private:
    void stop() {
        if (!m_lights)
            return;
        if (m_job || keeps())
            m_counts =
                with_levels(m_lights->learner().counts(), m_lights->groups().levels());
        else
            m_lights->set_group_levels({});
        m_lights->change_learner([&](auto &learner) { learner.stop(m_job || keeps()); });
        m_lights = nullptr;
    }

    /// With fewer samples, recording two more passes takes longer than it may gain; a recording
    /// takes longer with many materials and lamps
    static double least_total(const Scene *scene) {
        if constexpr (dr::is_jit_v<Float>)
            return kLeastTotal * std::max(1., count_callables(scene) / kCallables);
        else
            return 0;
    }
    static constexpr double kLeastTotal = dr::is_cuda_v<Float> ? 0x1p23 : 0x1p16,
                            kCallables  = 32;

    /// Go on from what the user has written
    void write_counts() {
        size_t rays = m_lights->learner().count_size(),
               size = rays + m_lights->groups().count();
        if (dr::width(m_counts) != size) {
            m_lights->change_learner([](auto &learner) { learner.stop(false); });
            m_lights = nullptr;
            refuse_counts(size);
        }
        using LearnerCounts = typename Lights::Learner::Counts;
        auto set            = [&](const LearnerCounts &counts) {
            m_lights->change_learner(
                [&](auto &learner) { learner.set_counts(m_lights->tree(), counts); });
        };
        if (size == rays)
            return set(LearnerCounts(dr::detach<false>(m_counts)));
        HostView numbers(m_counts);
        m_lights->set_group_levels({ numbers.data() + rays, numbers.data() + size });
        set(dr::load<LearnerCounts>(numbers.data(), rays));
    }

    /// What users get to see: counts of rays, and how bright groups of lights are
    template <typename LearnerCounts>
    static Counts with_levels(const LearnerCounts &counts,
                              const std::vector<uint32_t> &levels) {
        if (levels.empty())
            return Counts(counts);
        HostView view(counts);
        std::vector<uint32_t> numbers(view.data(), view.data() + view.size());
        numbers.insert(numbers.end(), levels.begin(), levels.end());
        return dr::load<Counts>(numbers.data(), numbers.size());
    }

    /// What is read on the host, or kept from one rendering to the next
    void refuse_recording(const Lights &lights, bool job) const {
        const char *what = job       ? "a \"plan\" whose passes learn visibility"
                           : keeps() ? "\"learn_visibility\" = \"keep\""
                           : lights.groups().count() > 0
                               ? "\"light_groups\" whose brightness is learnt"
                               : nullptr;
        if (what)
            throw std::runtime_error(
                "manylights: dr.freeze cannot record " + std::string(what) +
                ": what has been learnt is read by the host. Give the integrator "
                "\"learn_visibility\" = false.");
    }

    [[noreturn]] void refuse_counts(size_t size) const {
        std::string allowed =
            size ? std::to_string(size) +
                       " for this scene and number of samples, or none at all"
                 : "none: nothing is to be learnt in this scene";
        throw std::runtime_error("manylights: \"visibility.counts\" has " +
                                 std::to_string(dr::width(m_counts)) +
                                 " numbers, but must have " + allowed + ".");
    }

    const SamplingParameters &m_params;
    /// What has been learnt, for users
    Counts m_counts;
    /// Were they written? Do the lights know what this job has learnt so far?
    bool m_frozen = false, m_continues = false;
    /// In a rendering that learns or uses what was learnt
    Lights *m_lights = nullptr;
    bool m_job       = false;
};

} // namespace manylights

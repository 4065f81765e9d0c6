#include <manylights/export_plugin.h>
#include <manylights/light_cache.h>
#include <manylights/path_tracer.h>

NAMESPACE_BEGIN(mitsuba)

template <typename Float, typename Spectrum>
class ManyLightsVolpath final : public MonteCarloIntegrator<Float, Spectrum> {
public:
    MI_IMPORT_BASE(MonteCarloIntegrator, m_max_depth, m_rr_depth, m_hide_emitters)
    MI_IMPORT_TYPES(Scene, Sensor, Sampler, Medium)
    using Cache      = manylights::LightCache<Float, Spectrum>;
    using PathTracer = manylights::PathTracer<Float, Spectrum>;

    ManyLightsVolpath(const Properties &props)
        : Base(props), m_params(manylights::read_path_parameters(props)),
          m_cache(m_params.method == manylights::Method::Talk) {}

    TensorXf render(Scene *scene, Sensor *sensor, UInt32 seed, uint32_t spp, bool develop,
                    bool evaluate) override {
        typename Cache::Rendering guard(m_cache, scene);
        return Base::render(scene, sensor, seed, spp, develop, evaluate);
    }

    std::pair<Spectrum, Mask> sample(const Scene *scene, Sampler *sampler,
                                     const RayDifferential3f &ray, const Medium *medium,
                                     Float *, Mask active) const override {
        MI_MASKED_FUNCTION(ProfilerPhase::SamplingIntegratorSample, active);
        const auto &lights           = m_cache.get(scene, sampler);
        manylights::MediaKinds media = lights.media();
        media.add(medium);
        PathTracer tracer(scene, lights, media, m_params,
                          { m_max_depth, m_rr_depth, m_hide_emitters });
        return tracer.trace(sampler, Ray3f(ray), medium, active);
    }

    void traverse(TraversalCallback *cb) override {
        Base::traverse(cb);
        m_cache.traverse(cb);
    }

    std::string to_string() const override {
        std::ostringstream oss;
        oss << "ManyLightsVolpath[" << std::endl
            << "  " << string::indent(manylights::to_string(m_params)) << "," << std::endl
            << "  max_depth = " << (int) m_max_depth << "," << std::endl
            << "  rr_depth = " << (int) m_rr_depth << "," << std::endl
            << "  hide_emitters = " << (m_hide_emitters ? "true" : "false") << ","
            << std::endl
            << "  tree = " << string::indent(m_cache.to_string()) << std::endl
            << "]";
        return oss.str();
    }

    MI_DECLARE_CLASS(ManyLightsVolpath)

private:
    manylights::SamplingParameters m_params;
    Cache m_cache;
};

MANYLIGHTS_EXPORT_PLUGIN(ManyLightsVolpath)
NAMESPACE_END(mitsuba)

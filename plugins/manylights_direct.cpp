#include <manylights/direct/direct_light.h>
#include <manylights/plugin/export_plugin.h>
#include <manylights/render/light_integrator.h>
#include <manylights/scene/hidden_emitters.h>

NAMESPACE_BEGIN(mitsuba)

/**!

.. _integrator-manylights_direct:

Direct illumination from many lights (:monosp:`manylights_direct`)
------------------------------------------------------------------

.. pluginparameters::

 * - splitting_rate
   - |float|
   - How many lights are considered at each shading point: about 16 times this number,
     from 0 (a single random descent of the tree) to infinity (:code:`inf`: every light).
     (Default: 1)

 * - reservoirs
   - |int|
   - Lights that are kept for a full evaluation of BSDF and emission, 1 to 64. (Default: 16)

 * - shadow_rays
   - |int|
   - Lights that are tested for visibility at each shading point, 1 to :code:`reservoirs`.
     With as many as there are reservoirs all kept lights are, and all lights at infinity.
     (Default: 16)

 * - bsdf_samples
   - |int|
   - Rays sampled from the BSDF at each shading point, combined with the above by multiple
     importance sampling, 0 to 1024. 0 leaves light sampling alone, which is enough without
     large emitters and mirrors. (Default: 1)

 * - hide_emitters
   - |bool|
   - Hide directly visible emitters. (Default: no, i.e. |false|)

 * - learn_visibility
   - |bool| or |string|
   - Learn while rendering which lights can be seen from where, and prefer those. :code:`keep`
     goes on with what was learnt in earlier renderings, until lights or shapes move or lights
     are added. Method :code:`resampled_tree` only. (Default: yes, i.e. |true|)

 * - method
   - |string|
   - :code:`resampled_tree`: all that is described below. The others are for comparison.
     :code:`talk`: stochastic splitting of a binary tree as in the original publication.
     :code:`adaptive_splitting`: a node of the binary tree is split where the light of its
     cluster varies by more than all the light over 8 :code:`splitting_rate` (Conty Estevez
     and Kulla 2018), and every candidate gets a shadow ray, however many there are.
     :code:`tree`: one random descent and one shadow ray. :code:`exhaustive`: every light is a candidate.
     (Default: :code:`resampled_tree`)

 * - split_function
   - |string|
   - Method :code:`talk` only: how the probability of splitting decays with the distance of
     a cluster, :code:`near` (quadratically) or :code:`far` (linearly). (Default:
     :code:`near`)

 * - counts
   - |bool|
   - Adds the film channels :code:`candidates` and :code:`node_visits`: how many lights were
     considered, and how many nodes of the tree visited, on average per camera ray. Method
     :code:`resampled_tree` adds :code:`expected`: the luminance of the candidates' light that
     should arrive by what is known of their visibility, all of it where nothing is known.
     (Default: no, i.e. |false|)

 * - aovs
   - |string|
   - Film channels that describe what camera rays meet first: pairs :code:`NAME:TYPE` between commas,
     with the types and channels of Mitsuba's :monosp:`aov`: :code:`albedo`, :code:`depth`,
     :code:`position`, :code:`uv`, :code:`geo_normal`, :code:`sh_normal`, :code:`dp_du`,
     :code:`dp_dv`, :code:`duv_dx`, :code:`duv_dy`, :code:`prim_index` and :code:`shape_index`,
     and :code:`emission`, see below. (Default: none)

 * - light_groups
   - |string|
   - Groups of lights whose light has film layers of its own, see below:
     :code:`key=lamp_*,windows=facade`. (Default: none)

 * - plan, visibility.counts
   - |int| array
   - Passes of a job and what it has learnt, see below.
   - |exposed|

 * - lights, lights_in_tree, nodes, depth
   - |int|
   - Size of the light tree that was built last.
   - |exposed|, read-only

 * - bytes, build_ms
   - |float|
   - Its memory in bytes, and the time to build it in milliseconds.
   - |exposed|, read-only

This integrator computes direct illumination in scenes with very many lights: thousands to
millions of points, spots and emissive triangles. Each triangle of an emissive mesh is a
light of its own. It follows *A Resampled Tree for Many Lights Rendering* by Conty Estevez,
Hellmuth and Lecocq (SIGGRAPH Talks 2024). At each shading point,

1. one random number cuts a tree of the lights into :math:`N'` candidates. Let
   :math:`w_l(x)` be the probability that a random descent of the tree, steered by a cheap
   bound :math:`h` of the light that a cluster may send to :math:`x`, ends at light
   :math:`l`. With :math:`K = 16 \cdot` :code:`splitting_rate` points at equal distances,
   :math:`l` becomes a candidate with probability :math:`p_l = \min(1, K w_l)`;

2. if there can be more than :math:`m` (:code:`reservoirs`), they are resampled with a heuristic
   :math:`H` of single lights to :math:`m`; one that holds the sum of weights :math:`W` has the
   contribution weight :math:`C = W / H`, in place of :math:`1 / p_l`;

3. on each of these a point is sampled and :math:`F`, the product of BSDF, emission,
   geometry and MIS weight, is evaluated without visibility. With fewer than :math:`m` shadow
   rays, :math:`s` (:code:`shadow_rays`) of them are chosen with a probability proportional
   to the brightness :math:`|C F|`, the root mean square of its channels, and only these are
   traced:

.. math::

    L_o(x) \approx \sum_{i=1}^{s} V_i\, C_i\, F_i\, \max\left(1, \frac{\tau}{g_i}\right),
    \qquad g_i = |C_i F_i|,

where :math:`\tau` is the step of the systematic sampling that chose them (:math:`\tau = 0` if
all are traced). The estimate is unbiased, whatever :math:`h` and :math:`H`. With at most
:math:`m` lights there is no tree: all of them are kept. Environment maps, suns and directional
lights take part in step 3 at every point: up to eight of them all, of more one that is chosen at
random.

**It works well** wherever a few of many lights matter at each point, and the more so the more
lights there are. **It works less well**

- where most lights are hidden and there is too little to learn from, see below;
- for very few lights, or lights of equal importance, where Mitsuba's :monosp:`direct` does
  the same with less arithmetic.

**Learning visibility.** Some of the pixels, one at a random place in each block of 4 x 4, are
rendered first: their first samples, :math:`2^{17}` in all if there are as many. For each cell of
space and each node of the tree their shadow rays are counted: those that were traced to lights
below each of its children, and the share :math:`v` of them that arrived. All other samples weight
:math:`h`, :math:`H` and :math:`g` by :math:`\sqrt{v}`, or by a floor that falls from 0.05 to 0.02
with the number of rays; if nothing is hidden, they are rendered as usual. All samples count in the
image, which stays unbiased, and the same seed gives the same bits. The table takes at most 42 MB.
Nothing is learnt from images with fewer than :math:`2^{16}` samples in LLVM variants or
:math:`2^{23}` in CUDA variants, and more in proportion where there are more than 32 materials and
emissive shapes: there another pass costs more than it gains. Nothing is learnt, either, where all
lights are considered anyway, and while differentiating; an integrator that is nested in others which only ask
it for samples uses what it has kept, and learns nothing. What was kept is dropped with the
integrator: load another one to start anew.

**Surfaces in sight.** The channels of :code:`aovs` come from the same camera rays as the image,
which is the same with and without them, and are weighted by the same filter; with
:code:`hide_emitters` they do not show emitters either. Where nothing is met they are 0.
:code:`albedo` is for denoisers: that of the first surface that scatters light widely, seen through
mirrors, glass and holes, times what these leave of it, and on surfaces without a diffuse lobe all
that they reflect. :code:`shape_index` counts the shapes in their order in the scene from 1, in all
variants, and shows of instances the instance. Indices are averaged like all else where a pixel
has several. :code:`emission` is the radiance of the lamp or environment in sight, without the
media between. Films with bands of their own (:monosp:`specfilm`) take no further channels.

**Lamps in the picture.** A lamp that covers a hundredth of a pixel is found by one of a hundred
camera rays. Emissive triangles, spheres, disks and cylinders that cover less than a quarter of the
pixels that their image touches are therefore sampled from their side, too, and what a perspective
or thin lens camera sees of their points is put on the film, weighted against camera rays by the
balance heuristic. There are at most two points for each camera ray, most of them on lamps that are
bright for what they cover; lamps that are large, out of sight or seen in mirrors are left to rays.
This is part of rendering: integrators that nest this one, and gradients, have camera rays alone.

**Parts of a job.** A rendering that is not made by one call follows a plan, the entry
:code:`plan` of :code:`mi.traverse(integrator)`: four numbers for each pass, its first sample, the
number of samples of each pixel, its role (0: all pixels; 1: those that train; 2: the others) and a
scramble (0, or another number for other random numbers). :code:`visibility.counts` is what the
training passes have taught; written to another integrator, it renders the same bits. Passes of the
sampler :monosp:`manylights_sobol` are parts of one sequence for each pixel; of other samplers, each
has a pattern of its own. An empty plan ends the job.

**Light groups.** :code:`light_groups` is a list of :code:`group=pattern`, separated by commas. A
light belongs to the group of the first entry whose pattern (:code:`*`, :code:`?`, :code:`[a-z]`,
:code:`[!a-z]`) its id fits, or that of its shape; all others are the group :code:`rest`. A group may
have several entries; there are at most 16 groups. Ids that begin with a slash are paths of a USD stage:
their last part is an id, too, and what follows :code:`#` tells lights of one path apart. The film gets the channels
:code:`RGBA_key.R`, :code:`RGBA_key.G`, :code:`RGBA_key.B` and so on, in the order of their names:
all light that begins in the lamps of the group, from the same samples as the image, which is their
sum up to rounding. They are red, green and blue in any film. Where visibility is learnt, the
brightness of each group is, too, as the last entries of :code:`visibility.counts`. With fewer
shadow rays than kept lights the targets :math:`g_i` are divided by its square root (1/32 at most),
so that the noise of dim groups is about as large as that of bright ones in relation to their light.

Emitters of all kinds are supported. Point and spot lights and area lights on meshes, spheres,
disks and cylinders are evaluated without virtual function calls, so that kernels do not grow
with the number of lights; other emitters, and radiance that varies over a triangle, are
evaluated by their own plugins once they were selected. Shapes on which Mitsuba cannot choose a
point (curves) are found by BSDF sampling alone: with :code:`bsdf_samples` 0 a warning names the
first of them. As in Mitsuba's integrators, light sampling never chooses an emitter whose
:code:`sampling_weight` is 0, so that it is dark if rays cannot hit it; other weights do not matter
here. The unit of emission does not matter either.

Functions that :code:`dr.freeze` records give the images of functions that are not recorded, with
lamps and cameras that change between their calls. The light tree and the lamps that are small on
the film are brought up to date before each call, on the host: render each scene once with this
integrator and the same sensor outside of the function, and change lights and cameras outside of it.
With :code:`learn_visibility` it cannot be recorded if the value is :code:`keep`, with
:code:`light_groups` or with a :code:`plan`. The errors say so.

.. note:: This integrator does not handle participating media or indirect illumination.

.. tabs::
    .. code-tab::  xml
        :name: manylights-direct-integrator

        <integrator type="manylights_direct">
            <float name="splitting_rate" value="1"/>
            <integer name="bsdf_samples" value="1"/>
        </integrator>

    .. code-tab:: python

        'type': 'manylights_direct',
        'splitting_rate': 1.0,
        'bsdf_samples': 1

 */

template <typename Float, typename Spectrum>
using DirectBase = manylights::LightIntegrator<Float, Spectrum, SamplingIntegrator>;

template <typename Float, typename Spectrum>
class ManyLightsDirect final : public DirectBase<Float, Spectrum> {
public:
    MI_IMPORT_BASE(DirectBase, m_hide_emitters, m_params, m_cache, m_lamps, no_light,
                   write_layers)
    MI_IMPORT_TYPES(Scene, Sensor, Sampler, Medium, BSDF, BSDFPtr)
    using DirectLight = manylights::DirectLight<Float, Spectrum>;
    using GroupLight  = manylights::GroupLight<Float, Spectrum>;
    using GroupSums   = typename Base::Sums;

    ManyLightsDirect(const Properties &props)
        : Base(props, manylights::read_parameters(props)) {}

    std::pair<Spectrum, Mask> sample_weighted(const Scene *scene, Sampler *sampler,
                                              const RayDifferential3f &ray,
                                              const Spectrum *weight, const Medium *,
                                              Float *aovs, Mask active) const override {
        MI_MASKED_FUNCTION(ProfilerPhase::SamplingIntegratorSample, active);
        auto lights = m_cache.get(scene, sampler);
        DirectLight direct(scene, *lights, m_params);
        GroupSums groups;
        auto result =
            manylights::differentiable<Float>(sampler, (*lights).evaluates_loops(), [&] {
                groups = no_light(*lights);
                return manylights::call_flat<Float>([&] {
                    return radiance(scene, direct, sampler, ray, groups, aovs, active);
                });
            });
        write_layers(groups, weight, ray, aovs, active);
        Base::write_aovs(scene, ray, aovs, m_hide_emitters, active);
        return result;
    }

    /// Radiance along a ray, and whether it met anything
    std::pair<Spectrum, Mask> radiance(const Scene *scene, const DirectLight &direct,
                                       Sampler *sampler, const RayDifferential3f &ray,
                                       GroupSums &groups, Float *aovs,
                                       Mask active) const {
        auto pi = scene->ray_intersect_preliminary(ray, /* coherent = */ true, active);
        if (m_hide_emitters)
            manylights::skip_emitters(scene, Ray3f(ray), pi, active);
        SurfaceInteraction3f si =
            pi.compute_surface_interaction(ray, +RayFlags::All, active);
        Spectrum result(0.f);
        if (!m_hide_emitters) {
            auto light = direct.emission().light_at(si, active);
            result     = direct.emission().emitted(si, light, active);
            if (m_lamps)
                result = manylights::weigh_lamp<Float>(
                    result, m_lamps->weight(si, ray.d, light, active));
        }

        GroupLight light(groups);
        if (light.is_wanted()) {
            light.set_factor(Spectrum(1.f));
            light.add(result, direct.groups().of_hit(si), active);
        }
        active &= si.is_valid();
        Mask valid_ray = active;
        manylights::Counts<Float> counts;
        if (m_params.counts)
            counts.write(aovs, m_params);
        if (dr::none_or<false>(active))
            return { result, valid_ray };

        // Always the same dimensions of the sampler, so that stratification pays
        manylights::LightSample<Float> u{ sampler->next_1d(active),
                                          sampler->next_1d(active),
                                          sampler->next_2d(active) };
        BSDFPtr bsdf = si.bsdf(ray);
        auto vertex  = direct.prepare(si, bsdf, nullptr, u, UInt32(0), active);
        Mask lit     = vertex.is_lit_surface(active);
        if (dr::any_or<true>(lit))
            result += direct.sample_lights(vertex, counts, light, lit);
        if (m_params.counts)
            counts.write(aovs, m_params);
        if (direct.needs_bsdf_samples())
            result += direct.sample_bsdf(vertex, sampler, light, active);
        return { result, valid_ray };
    }

    std::string to_string() const override {
        std::ostringstream oss;
        oss << "ManyLightsDirect[" << std::endl
            << "  " << string::indent(Base::describe_parameters()) << "," << std::endl
            << "  hide_emitters = " << (m_hide_emitters ? "true" : "false") << ","
            << std::endl
            << "  tree = " << string::indent(m_cache.to_string()) << std::endl
            << "]";
        return oss.str();
    }

    MI_DECLARE_CLASS(ManyLightsDirect)
};

MANYLIGHTS_EXPORT_PLUGIN(ManyLightsDirect)
NAMESPACE_END(mitsuba)

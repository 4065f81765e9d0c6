#include <manylights/base/divide.h>
#include <manylights/base/properties.h>
#include <manylights/plugin/export_plugin.h>
#include <manylights/sampler/sobol.h>
#include <mitsuba/core/random.h>
#include <mitsuba/render/sampler.h>
#include <sstream>

NAMESPACE_BEGIN(mitsuba)

/**!

.. _sampler-manylights_sobol:

Scrambled Sobol' sequences (:monosp:`manylights_sobol`)
-------------------------------------------------------

.. pluginparameters::

 * - sample_count
   - |int|
   - Number of samples per pixel, from 1 to :math:`2^{32} - 1`; any number, none is rounded.
     (Default: 4)

 * - seed
   - |int|
   - Another number gives other samples, from 0 to :math:`2^{32} - 1`. (Default: 0)

 * - first_sample
   - |int|
   - The number of the first sample, which :code:`mi.traverse` reads and writes; not a parameter of
     scene files. (Default: 0)
   - |exposed|

A sampler for any of Mitsuba's integrators. The samples of a pixel are those of one endless
sequence: the first 16 of 64 samples are the same as those of a rendering with 16, and samples 16 to
63 may follow later, or elsewhere (:code:`first_sample`). The sequence is well distributed wherever
it ends, and best after 1, 2, 4, 8, 16... samples. Each sample is computed from its number, without
tables and without a state: scalar, LLVM and CUDA variants have the same sequences.

Each request of an integrator, for a number or for a pair, has its own Sobol' sequence in one or
two dimensions, shuffled and Owen-scrambled with a hash of seed, pixel and number of the request
(Burley 2020). Every aligned block of :math:`2^k` samples has one of them in each of :math:`2^k`
intervals of the same size, and pairs have one in each elementary interval, whatever its shape.

It works well where the radiance of a pixel is smooth, or has few jumps, in each pair of random
numbers: soft shadows, glossy reflections, antialiasing, depth of field, the first bounces of paths.
It then needs fewer samples than :monosp:`independent` for the same error, and about as many as
:monosp:`multijitter`, or fewer; it is as fast as the first and faster than the second.

It gains little

- after many bounces of long paths, and where other requests come in between for some samples only,
  such as those of media with varying density: what one request leaves over of the variance, the
  stratification of others does not remove;
- where an integrator chooses one of many emitters with a number that it then uses for a point on
  it, as Mitsuba's :monosp:`direct` and :monosp:`path` do: each light gets few of the points;
- in blocks of samples that are not aligned: samples 3 to 10 are less even than 0 to 7 or 8 to 15.

Numbers of different requests are not stratified together, where :monosp:`orthogonal` may have less
error, with sample counts that are squares of primes. Pixels are independent of each other: the
noise is white.

Sources: Art Owen, *Randomly permuted (t, m, s)-nets and (t, s)-sequences*, 1995; Samuli Laine and
Tero Karras, *Stratified sampling for stochastic transparency*, 2011; Brent Burley, *Practical
hash-based Owen scrambling*, JCGT 9(4), 2020.

.. tabs::
    .. code-tab::  xml
        :name: manylights-sobol-sampler

        <sampler type="manylights_sobol">
            <integer name="sample_count" value="64"/>
        </sampler>

    .. code-tab:: python

        'type': 'manylights_sobol',
        'sample_count': 64

 */

/// The properties, once they were checked
inline const Properties &checked(const Properties &props) {
    for (const char *name : { "sample_count", "seed" })
        manylights::read_count(props, name, 4, std::string_view(name) == "seed" ? 0 : 1,
                               (uint32_t) -1);
    return props;
}

template <typename Float, typename Spectrum>
class SobolSampler final : public Sampler<Float, Spectrum> {
public:
    MI_IMPORT_BASE(Sampler, m_base_seed, m_sample_count, m_samples_per_wavefront,
                   m_wavefront_size, m_dimension_index, m_sample_index, seeded)
    MI_IMPORT_TYPES()

    SobolSampler(const Properties &props)
        : Base(checked(props)), m_first_sample(dr::opaque<UInt32>(0)) {}

    ref<Base> fork() override {
        ref<SobolSampler> sampler = new SobolSampler(*this);
        sampler->m_wavefront_size = 0;
        return sampler.get();
    }

    ref<Base> clone() override { return new SobolSampler(*this); }

    /// The key of each lane's sequence, or one number for all of them
    void seed(UInt32 seed, uint32_t wavefront_size = (uint32_t) -1) override {
        Base::seed(seed, wavefront_size);
        if constexpr (dr::is_jit_v<Float>)
            seed = seed_lanes(seed);
        m_key = sample_tea_32(dr::opaque<UInt32>(m_base_seed), seed).first;
    }

    Float next_1d(Mask = true) override {
        Assert(seeded());
        return fraction(next_sequence().number(sample_index()));
    }

    Point2f next_2d(Mask = true) override {
        Assert(seeded());
        auto [x, y] = next_sequence().pair(sample_index());
        return { fraction(x), fraction(y) };
    }

    void traverse(TraversalCallback *cb) override {
        Base::traverse(cb);
        cb->put("first_sample", m_first_sample, ParamFlags::NonDifferentiable);
    }

    std::string to_string() const override {
        std::ostringstream oss;
        oss << "SobolSampler[" << std::endl
            << "  base_seed = " << m_base_seed << "," << std::endl
            << "  sample_count = " << m_sample_count << "," << std::endl
            << "  first_sample = " << m_first_sample << std::endl
            << "]";
        return oss.str();
    }

    MI_DECLARE_CLASS(SobolSampler)

private:
    using Sequence = manylights::SobolSequence<UInt32>;

    SobolSampler(const SobolSampler &) = default;

    /// Returns the keys of the lanes, and numbers the samples of each
    UInt32 seed_lanes(UInt32 seed) {
        size_t width = dr::width(seed);
        if (width != 1 && width != m_wavefront_size)
            Throw("seed(): there are %u seeds, but must be 1 or as many as there are "
                  "lanes in the wavefront, %u.",
                  width, m_wavefront_size);
        // Numbers that kernels do not know, so that passes have one kernel
        if (dr::width(m_first_sample) == 1)
            dr::make_opaque(m_first_sample);
        UInt32 pixel = dr::arange<UInt32>(m_wavefront_size);
        m_stride     = dr::opaque<UInt32>(m_samples_per_wavefront);
        m_number     = 0;
        if (m_samples_per_wavefront > 1)
            std::tie(pixel, m_number) =
                manylights::divide(pixel, m_samples_per_wavefront);
        if (width > 1)
            return seed;
        dr::make_opaque(seed);
        return sample_tea_32(seed, pixel).first;
    }

    UInt32 sample_index() const {
        return m_first_sample + m_number + m_sample_index * m_stride;
    }

    Sequence next_sequence() {
        UInt32 request = m_dimension_index++;
        return Sequence(manylights::mix_bits<UInt32>(m_key + request * 0x9e3779b9u));
    }

    /// In [0, 1): the digits that fit
    static Float fraction(const UInt32 &digits) {
        if constexpr (std::is_same_v<ScalarFloat, float>)
            return Float(Int32(digits >> 8u)) * 0x1p-24f;
        else
            return Float(digits) * 0x1p-32;
    }

    /// Number of the first sample, that of a lane's sample among those of its pixel, and how
    /// far advance() goes
    UInt32 m_first_sample, m_number = 0, m_stride = 1;
    /// Of each lane
    UInt32 m_key = 0;

public:
    /// Loops change nothing but the number of the request
    void traverse_1_cb_ro(void *payload,
                          drjit::detail::traverse_callback_ro fn) const override {
        if (!jit_flag(JitFlag::EnableObjectTraversal))
            return drjit::traverse_1_fn_ro(m_dimension_index, payload, fn);
        Base::traverse_1_cb_ro(payload, fn);
        DRJIT_MAP(DR_TRAVERSE_MEMBER_RO, m_first_sample, m_number, m_stride, m_key)
    }
    void traverse_1_cb_rw(void *payload,
                          drjit::detail::traverse_callback_rw fn) override {
        if (!jit_flag(JitFlag::EnableObjectTraversal))
            return drjit::traverse_1_fn_rw(m_dimension_index, payload, fn);
        Base::traverse_1_cb_rw(payload, fn);
        DRJIT_MAP(DR_TRAVERSE_MEMBER_RW, m_first_sample, m_number, m_stride, m_key)
    }
};

MANYLIGHTS_EXPORT_PLUGIN(SobolSampler)
NAMESPACE_END(mitsuba)

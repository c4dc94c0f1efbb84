import functools

import drjit as dr
import mitsuba as mi


def register_tinted():
    """Make the plug-in "tinted" known to Mitsuba, for the variant in use."""
    _register(mi.variant())


@functools.cache
def _register(variant):
    class Tinted(mi.BSDF):
        """A diffuse reflector of one colour, `tint`."""

        def __init__(self, properties):
            super().__init__(properties)
            self.tint = mi.Color3f(properties.get("tint", mi.ScalarColor3f(0.5)))
            self.m_components = [mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide]
            self.m_flags = self.m_components[0]

        def traverse(self, callback):
            callback.put("tint", self.tint, mi.ParamFlags.Differentiable)

        def sample(self, context, si, sample1, sample2, active):
            bs = mi.BSDFSample3f()
            bs.wo = mi.warp.square_to_cosine_hemisphere(sample2)
            bs.pdf = mi.warp.square_to_cosine_hemisphere_pdf(bs.wo)
            bs.eta, bs.sampled_type, bs.sampled_component = 1.0, mi.UInt32(+self.m_flags), 0
            return bs, self.tint & (active & (mi.Frame3f.cos_theta(si.wi) > 0) & (bs.pdf > 0))

        def eval(self, context, si, wo, active):
            return self.tint * self.pdf(context, si, wo, active)

        def pdf(self, context, si, wo, active):
            above = (mi.Frame3f.cos_theta(si.wi) > 0) & (mi.Frame3f.cos_theta(wo) > 0)
            return dr.select(active & above, mi.warp.square_to_cosine_hemisphere_pdf(wo), 0.0)

        def eval_pdf(self, context, si, wo, active):
            return self.eval(context, si, wo, active), self.pdf(context, si, wo, active)

        def to_string(self):
            return "Tinted[]"

    mi.register_bsdf("tinted", Tinted)

"""Can these logs be used, and what do they show before anything is simulated?"""
